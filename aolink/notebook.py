"""Recordings with methods for notebooks: what `aolink.read` gives."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, overload

from aolink.exporting.arrays import to_xarray
from aolink.exporting.common import needed
from aolink.exporting.table import to_pandas
from aolink.exposure import Exposure
from aolink.plotting.overview import need_exposures, overview
from aolink.plotting.session import plot_blur, plot_nis
from aolink.recording.reader import Recording
from aolink.recording.slices import RecordingSlice
from aolink.series import Series

if TYPE_CHECKING:
    import pandas as pd
    import xarray as xr
    from matplotlib.axes import Axes

_SIZE_IN = (10.0, 6.0)


class NotebookSeries(Series):
    """A series with its tables and its figure."""

    def to_pandas(self, estimators: Sequence[str] | None = None) -> pd.DataFrame:
        """A table with a row for each exposure and axis, indexed by time (UTC).

        The columns are those of `aolink.exporting.table`, for all estimators or for those that are named.

        Raises
        ------
        RecordingError
            There are no estimates of such a name.
        ExportError
            There is no exposure, or pandas is missing.
        """
        return to_pandas(self, estimators)

    def to_xarray(self, estimators: Sequence[str] | None = None) -> xr.Dataset:
        """The whole series as one dataset along ``time`` (UTC): frames, inputs, truth, and estimates along
        ``estimator``.

        The variables are those of `aolink.exporting.arrays`, all in memory: take a slice of a long recording.

        Raises
        ------
        RecordingError
            There are no estimates of such a name.
        ExportError
            There is no exposure, the exposures have different sizes, it would be too large, or xarray is missing.
        """
        return to_xarray(self, estimators)

    def plot(
        self, estimators: Sequence[str] | None = None, *, output: int = 0, axes: tuple[Axes, Axes] | None = None
    ) -> tuple[Axes, Axes]:
        """Draw with matplotlib the camera's blur of one output with the paths over it, and the NIS of the estimates.

        Parameters
        ----------
        estimators:
            Estimators whose paths and NIS are drawn; all by default.
        output:
            Number of the output (a row of a path).
        axes:
            The two axes to draw on; by default those of a new figure.

        Returns
        -------
        The axes with the paths, and those with the NIS.

        Raises
        ------
        RecordingError
            There are no estimates of such a name.
        ExportError
            There is no exposure or no such output, or matplotlib is missing.
        """
        view = overview(self, estimators, output=output)
        need_exposures(view)
        if axes is None:
            pyplot = needed("matplotlib.pyplot", "plot", "a plot")
            figure = pyplot.figure(figsize=_SIZE_IN, layout="constrained")
            axes = figure.subplots(2, 1, sharex=True, height_ratios=(3, 1))
        above, below = axes
        plot_blur(view, above, names=["truth", *view.names])
        if view.nis:
            plot_nis(view, below, one_axis=True)
        above.set_xlabel("")
        return above, below


class NotebookRecording(NotebookSeries, Recording):
    """A `Recording` for notebooks, and so are its slices."""

    @overload
    def __getitem__(self, index: int) -> Exposure: ...
    @overload
    def __getitem__(self, index: slice) -> NotebookSlice: ...
    def __getitem__(self, index: int | slice) -> Exposure | NotebookSlice:
        return NotebookSlice(self, range(len(self))[index]) if isinstance(index, slice) else super().__getitem__(index)


class NotebookSlice(NotebookSeries, RecordingSlice):
    """A slice of a recording for notebooks."""

    @overload
    def __getitem__(self, index: int) -> Exposure: ...
    @overload
    def __getitem__(self, index: slice) -> NotebookSlice: ...
    def __getitem__(self, index: int | slice) -> Exposure | NotebookSlice:
        chosen = self.numbers[index]
        return NotebookSlice(self.recording, chosen) if isinstance(chosen, range) else self.recording[chosen]
