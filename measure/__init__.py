"""triball: the 6-DoF pose of anything with three coloured balls on it, seen by cheap cameras.

The package is a house of rooms; `docs/architecture.md` draws them. A notebook needs
`measure.api`, a plugin author `measure.host` and `measure.testing`.
"""
