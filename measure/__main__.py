"""`python -m measure` is `measure`."""

from __future__ import annotations

import sys

from measure.cli.app import main

sys.exit(main())
