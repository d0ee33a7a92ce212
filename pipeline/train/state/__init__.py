"""The state of a training: Gaussians with their optimizer, density control, history, checkpoints."""
