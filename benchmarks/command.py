"""What all the commands of the benchmarks have in common."""

from __future__ import annotations

import sys
from collections.abc import Callable

from measure.errors import MeasureError


def run_command(main: Callable[[], None]) -> None:
    """Run a command; what its user can mend is one line and exit code 2, not a traceback."""
    try:
        main()
    except MeasureError as error:
        print(f"benchmarks: {' '.join(str(error).split())}", file=sys.stderr)
        raise SystemExit(2) from None
