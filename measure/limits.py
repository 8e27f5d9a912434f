"""Numbers that all rooms mean alike; none changes a result that anything measures.

A threshold with a reason of its own stands beside what it limits.
"""

from __future__ import annotations

MAX_STEPS = 50
"""Of an iteration that ends by itself: where it takes so many, it does not converge."""
SETTLED = 1e-8
"""Steps of an iteration, in mm and rad, that end it."""
TINY = 1e-12
"""Keeps zero out of divisions, roots and logarithms."""
SINGULAR = 1e-9
"""Share of the largest eigenvalue below which a direction counts as undetermined."""
SIGNIFICANT_SIGMAS = 4.0
"""Standard deviations from which a difference is not put down to chance: 1 in 16,000."""
HUBER_SIGMAS = 2.5
"""Standard deviations from which a residual counts by its size, no longer by its square."""
STUDENT_DEGREES = 4.0
"""Degrees of freedom of Student's t distribution, of what is several times larger now and then."""
CLEAR_RATIO = 3.0
"""Times as badly another explanation must fit, or something must behave, to stand apart."""
GAP_PERIODS = 1.5
"""Steps in time longer than so many usual ones hold something missing."""
MAX_PAUSE_S = 0.5
"""Poses farther apart in time say nothing of the motion between them."""
SINCE_1970_S = 1e9
"""Times from here on (2001 and later) count from 1970, not since something was switched on."""
PATIENCE_S = 60.0
"""How long another program, or what compiles, may take to answer."""
LEVER_MM = 100.0
"""A turn counts as what it moves at this distance."""
FEWEST = 10
"""Poses, frame sets or states: fewer do not tell how much they scatter."""
SPREAD_OVER = 24
"""Instants, evenly spread over a recording, that stand for all of it."""
AT_ONCE = 4096
"""Rows or points worked on together: arrays stay small."""
MOST_LETTERS = 100
"""Characters that a message shows of what others wrote."""
MOST_LISTED = 10
"""Things of one kind that a message names; of more it says how many."""
