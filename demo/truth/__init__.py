"""What is true of it: poses, surface, depths, and what each photo sees."""
