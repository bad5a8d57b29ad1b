"""How a function of one ray becomes a native kernel over millions."""
