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
    tracked = _TrackedReport(report)
    try:
        estimator.fit(data, validation, seed=seed, report=tracked)
    except Exception as error:
        theirs = tracked.raised_before(error)
        if theirs is None and not isinstance(error, MeasureError):
            raise FitError(str(failure("estimator", estimator, "fitting", error))) from error
        if theirs is None or theirs is error:
            raise
    else:
        return
    raise theirs


class _TrackedReport:
    """A progress callback, of shares from 0 to 1, that keeps the exceptions it raised."""

    def __init__(self, report: Report) -> None:
        self._report = report
        self._raised: list[Exception] = []

    def __call__(self, done: float, what: str) -> None:
        share = min(max(0.0, float(done)), 1.0)
        try:
            self._report(share, what)
        except Exception as error:
            self._raised.append(error)
            raise

    def raised_before(self, error: BaseException | None) -> Exception | None:
        """The exception of the callback that is `error`, or its cause."""
        seen: list[BaseException] = []
        while error is not None and error not in seen:
            if isinstance(error, Exception) and error in self._raised:
                return error
            seen.append(error)
            error = error.__cause__ or error.__context__
        return None
