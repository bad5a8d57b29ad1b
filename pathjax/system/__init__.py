"""Files, streams and signals."""
