"""Image files, and how images compare."""
