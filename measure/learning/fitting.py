"""Fitting an estimator; its failures are kept apart from those of the progress callback."""

from __future__ import annotations

from measure.errors import FitError, MeasureError
from measure.host import Dataset, Estimator, Report
from measure.host.registry import failure


def fit(
    estimator: Estimator, data: Dataset, validation: Dataset, *, seed: int, report: Report
) -> None:
    """Fit an estimator; FitError if it fails.

    An exception raised by `report` (to end a fit, say) is raised unchanged, also where the
    estimator raises another one after it.
    """
    raised: list[Exception] = []

    def tracked(done: float, what: str) -> None:
        share = min(max(0.0, float(done)), 1.0)
        try:
            report(share, what)
        except Exception as error:
            raised.append(error)
            raise

    try:
        estimator.fit(data, validation, seed=seed, report=tracked)
    except Exception as error:
        if raised:
            raise raised[-1] from None
        if isinstance(error, MeasureError):
            raise
        raise FitError(str(failure("estimator", estimator, "fitting", error))) from error
