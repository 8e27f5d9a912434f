"""What a notebook calls; the command line calls nothing else.

What they are stands in `__init__.pyi`; each loads with what it needs when it is asked for.
Everywhere `registry` holds the plugins, `overwrite` lets an output be replaced that is there, and
`progress` is called with what is done of the pictures, frame sets or cameras, and how many there
are.
"""

from measure.lazily import load_lazily

__all__ = load_lazily(__name__)
