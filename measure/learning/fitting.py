"""Letting an estimator learn, and telling its failures from those of who watches it."""

from __future__ import annotations

from measure.errors import FitError, MeasureError
from measure.host import Dataset, Estimator, Report
from measure.host.failures import failure


def fit(
    estimator: Estimator, data: Dataset, validation: Dataset, *, seed: int, report: Report
) -> None:
    """Let an estimator learn, as its own `fit` does.

    What `report` raises, to end a fit for instance, comes out as it is, whatever the estimator
    makes of it.

    Raises:
        EstimatorError: the data cannot be learnt from.
        FitError: the estimator fails.
    """
    watch = _Watch(report)
    try:
        estimator.fit(data, validation, seed=seed, report=watch)
    except Exception as error:
        theirs = watch.raised_before(error)
        if theirs is None and not isinstance(error, MeasureError):
            raise FitError(str(failure("estimator", estimator, "fitting", error))) from error
        if theirs is None or theirs is error:
            raise
    else:
        return
    raise theirs


class _Watch:
    """A report that remembers what it raised.

    Shares are brought between 0 and 1 before they are reported: an estimator that says NaN is not
    to blame whoever counts in whole numbers.
    """

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
        """What it raised that `error` is, or came of."""
        seen: list[BaseException] = []
        while error is not None and error not in seen:
            if isinstance(error, Exception) and error in self._raised:
                return error
            seen.append(error)
            error = error.__cause__ or error.__context__
        return None
