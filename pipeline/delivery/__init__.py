"""What survey teams hand over beside the splat: cameras, points and scenes for other programs."""
