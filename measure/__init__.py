"""triball: the 6-DoF pose of anything with three coloured balls on it, seen by cheap cameras.

A notebook needs the names below: cameras, a body and a run as objects with arrays. They load when
they are asked for. `measure.api` has every command as a function from folder to folder; a plugin
author needs `measure.host` and `measure.testing`. `docs/architecture.md` draws the packages.
"""

from measure.lazily import load_lazily

__all__ = load_lazily(__name__)
