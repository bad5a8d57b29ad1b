"""What varies over a surface."""
