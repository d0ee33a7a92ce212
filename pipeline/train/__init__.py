"""Training: the schedule, an iteration, density control, appearance, budgets, checkpoints."""
