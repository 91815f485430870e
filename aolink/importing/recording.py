"""A film becomes a recording like any other."""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Iterable, Iterator
from importlib.metadata import version
from itertools import chain
from pathlib import Path

from google.protobuf.message import Message

from aolink.devices.interfaces import Lacks
from aolink.errors import ImportingError, RecordingError
from aolink.files import check_target, open_unfinished, writing
from aolink.films.film import Film
from aolink.importing.exposures import imported
from aolink.importing.frames import FilmAccount, FilmSettings, ImportedExposure
from aolink.recording import convert, topics
from aolink.recording.mcap_file import AT_LEISURE, McapFile, schema_of
from aolink.recording.writer import begin_recording
from aolink.rig import Rig, parse_rig
from aolink.rig.edit import with_value
from aolink.wire.messages_pb2 import Applied

_AT_ONCE = 65_536
"""Numbers in one report of inputs."""


def import_film(
    film: Film, rig: Rig, settings: FilmSettings, path: Path, *, overwrite: bool = False,
    sources: Iterable[Path] = (), progress: Callable[[int], None] = lambda exposures: None,
) -> FilmAccount:  # fmt: skip
    """Write the exposures of a film as a recording of a rig. The same film and settings give the same bytes.

    ``sources`` are files that it never replaces. Raises `ImportingError` where the film does not fit the rig file (no
    file is left then); `RecordingError` where ``path`` exists and not ``overwrite``, or cannot be written.
    """
    check_target(path, overwrite=overwrite, sources=sources, error=RecordingError)
    if settings.row_time_s is not None:
        rig = parse_rig(with_value(rig.toml, "sensor.row_time_s", settings.row_time_s, may_be_new=True), rig.folder)
    account = FilmAccount()
    made = imported(film, rig, settings, account)
    first = next(made, None)  # errors of the whole film show before the file is made
    if first is None:
        raise ImportingError(f"{film.name} has {film.count} frames: not enough for {settings.frames_per_exposure}")
    none = (
        f"; {film.left_out} of {film.count + film.left_out} frames are missing: {film.account}" if film.account else ""
    )
    facts = {
        "aolink_version": version("aolink"),
        "rig": rig.name,
        "rig_digest": rig.digest,
        "camera": f"{'slopes without pictures, ' if film.slopes else ''}imported from {film.name}{none}",
        "mirror": "none" if film.inputs is None else f"imported from {film.name}",
        "import_settings": str(settings),
    }
    if rig.sensor.row_time_s is None and not film.slopes:
        facts["camera_lacks"] = str(Lacks.ROWS)
    with writing(path, overwrite=overwrite, sources=sources, error=RecordingError) as partial:
        file = McapFile(partial, AT_LEISURE, descriptor=open_unfinished(partial))
        try:
            begin_recording(file, rig, facts, first.frame.host_start_ns, {})
            sequence, digest = 0, hashlib.sha256(f"{film.name} {settings} {rig.digest}".encode())
            for each in chain([first], made):
                for topic, message in _messages(each):
                    sequence += 1
                    data = message.SerializeToString(deterministic=True)
                    digest.update(data)
                    file.add(topic, schema_of(type(message)), data, each.frame.host_receive_ns, sequence)
                progress(account.exposures)
            # Another film is another session, even one of the same name; its digest is known after its last pixel.
            file.add_metadata(topics.SESSION_METADATA, {"session": digest.hexdigest()[:16]})
            file.add_metadata(topics.END_METADATA, {"ended": "end of the film", "exposures": str(account.exposures)})
            file.finish()
        except BaseException:
            file.cut_back()
            raise
    return account


def _messages(each: ImportedExposure) -> Iterator[tuple[str, Message]]:
    frame, inputs = each.frame, each.inputs
    info, image = convert.frame_messages(frame)
    yield topics.EXPOSURE, info
    yield topics.IMAGE, image
    rows = max(1, _AT_ONCE // max(1, inputs.shape[1]))
    first = frame.last_step + 1 - len(inputs)
    for k in range(0, len(inputs), rows):
        some = inputs[k : k + rows]
        yield topics.APPLIED, Applied(first_step=first + k, n_steps=len(some), u=some.ravel())
