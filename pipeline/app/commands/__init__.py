"""What every command shares: its parameters, preparation, console and summary."""
