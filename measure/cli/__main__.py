"""`python -m measure.cli` is `measure`."""

from __future__ import annotations

import sys

from measure.cli.app import main

sys.exit(main())
