"""Shapes: a file a kind, a bounding volume hierarchy over any of them, and `geometry`, which the rest of the code sees.

Each kind keeps its primitives twice: in `leaves`, (L, K, W), K numbers of W primitives side by side for intersection
in SIMD, and as rows of its own arrays, for everything that is asked of the one primitive that was hit.
"""
