"""The process: atomic file writes, results and messages, JSON, signals. Independent of rendering."""
