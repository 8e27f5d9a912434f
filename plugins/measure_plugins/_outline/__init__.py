"""Sub-pixel outlines of balls: the compiled work behind the `outline` detector.

Everywhere, of n rays across an outline, `around` (n, 2) are the cosines and sines of their angles
around the axis of the ball's cone, and `status` (n,) says which are clear (see `RaySet`); `diffuse`
(m, 6) at m steps along them is that of `RadialTables`.
"""
