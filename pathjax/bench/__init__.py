"""Benchmarks: speed against error, with a peer in the same run."""
