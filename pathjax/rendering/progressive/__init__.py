"""Renders that go on until an error is reached, can be interrupted, and leave a state that can be taken up again.

`until` decides when to stop and how many samples come next, `passes` renders them, `replicates` is how samples are
split so that their spread tells the error, `error_estimate` tells it, `checkpoint` keeps the state on disk.
"""
