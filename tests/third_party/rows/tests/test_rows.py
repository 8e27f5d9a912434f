from typing import ClassVar

from acme_rows import HEADING, ROWS

from measure.testing import FormatConformance

LINE = "left 640 480 500 500 320 240 1 0 0 0 0 1 0 0 0 0 1 900"


class TestRows(FormatConformance):
    format = ROWS
    calibrations: ClassVar = {"a.rows": f"{HEADING}\n{LINE}"}
