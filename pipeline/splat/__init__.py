"""The splat: Gaussians, their files, what is behind them, and measures of likeness."""
