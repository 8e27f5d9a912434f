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
    estimator raises another one from it.
    """
    raised: list[BaseException] = []

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
        theirs = next((one for one in _with_causes(error) if one in raised), None)
        if theirs is None and not isinstance(error, MeasureError):
            raise FitError(str(failure("estimator", estimator, "fitting", error))) from error
        if theirs is None or theirs is error:
            raise
    else:
        return
    raise theirs


def _with_causes(error: BaseException) -> list[BaseException]:
    """An exception and what it was raised from, the latest first."""
    found: list[BaseException] = []
    at: BaseException | None = error
    while at is not None and at not in found:
        found.append(at)
        at = at.__cause__ or at.__context__
    return found
