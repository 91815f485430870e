"""Files that Rerun opens."""

from __future__ import annotations

import warnings
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path

import rerun as rr
from rerun.chunk import RrdReader
from rerun.error_utils import RerunWarning

from aolink.errors import ViewerError
from aolink.files import writing


@contextmanager
def new_rrd(
    application: str, path: Path, *, overwrite: bool = False, sources: Iterable[Path] = (), identity: str | None = None
) -> Iterator[rr.RecordingStream]:
    """A stream into a new .rrd file, which appears when the block has ended well; it has to send a layout.

    Files of one ``application`` with the same ``identity`` are one recording to Rerun; with None each file is one of
    its own.

    Raises
    ------
    ViewerError
        The file exists and not ``overwrite``, is one of the ``sources``, or cannot be written.
    """
    stream = rr.RecordingStream(application, recording_id=identity)
    failed = ViewerError(f"cannot write {path}: Rerun could not finish the file; is the disk full?")
    with writing(path, overwrite=overwrite, sources=sources, suffix=".rrd", error=ViewerError) as partial:
        try:
            try:
                stream.save(partial)
            except RuntimeError:
                raise failed from None
            yield stream
        finally:
            stream.disconnect()
        if not _is_whole(partial):
            raise failed


def _is_whole(path: Path) -> bool:
    """Whether a file holds a layout and its footer, which come last: Rerun only logs it when a write fails."""
    with warnings.catch_warnings():
        warnings.simplefilter("error", RerunWarning)
        try:
            return bool(RrdReader(path).blueprints())
        except (RuntimeError, RerunWarning):
            return False
