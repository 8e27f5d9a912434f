"""Calibration: targets, lenses, camera poses, refinement from motion, and how good it all is.

What the names are stands in `__init__.pyi`; each loads when it is asked for: every run looks after
its cameras, and needs no board for that.
"""

from measure.lazily import load_lazily

__all__ = load_lazily(__name__)
