"""A training sized to its machine: measured steps, the plan that fits time and memory, and shortages."""
