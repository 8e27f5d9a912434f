"""Sub-pixel outlines of balls: the compiled work behind the `outline` detector."""
