"""The run folder: written row by row, read back, evaluated, exported.

What the names are stands in `__init__.pyi`; each loads when it is asked for.
"""

from measure.lazily import load_lazily

__all__ = load_lazily(__name__)
