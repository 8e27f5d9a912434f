"""Numbers that random generators begin with."""

from __future__ import annotations

from measure.errors import ConfigError

_LARGEST = 2**32 - 1


def check_seeds(**seeds: int) -> None:
    """Refuse seeds that not every generator takes, by the names of their options.

    Raises:
        ConfigError: one is negative, or has more than 32 bits.
    """
    for name, seed in seeds.items():
        if not 0 <= seed <= _LARGEST:
            option = "--" + name.replace("_", "-")
            raise ConfigError(f"{option} {seed}: expected a number from 0 to {_LARGEST}")
