"""The process: files that appear whole, results and messages, JSON, signals. Knows nothing of rendering."""
