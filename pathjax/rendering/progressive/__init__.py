"""Renders that continue until an error is reached, can be interrupted, and resumed from a saved state.

`until` decides when to stop and how many samples come next, `passes` renders them, `replicates` splits the samples into
independent parts, `error_estimate` estimates the error from their spread, `checkpoint` saves the state on disk.
"""
