"""Images and queries from a scene: `render`, `bounces`, `aovs`, `query`, and `check` of their derivatives.

`progressive` renders until an error, a time or a number of samples is reached.
"""
