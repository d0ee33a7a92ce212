"""The jobs of a batch: their plan, the workflow engine that runs them, and what became of each attempt."""
