"""The command that installs an extra is one that works where aolink came from."""

import json

import pytest

from aolink.extensions import install_command


@pytest.mark.parametrize(
    ("origin", "command"),
    [
        (None, "pip install 'aolink[tables]'"),
        ({"url": "file:///a%20b/aolink", "dir_info": {"editable": True}}, "pip install -e '/a b/aolink[tables]'"),
        ({"url": "file:///a/aolink", "dir_info": {}}, "pip install '/a/aolink[tables]'"),
        ({"url": "https://host/aolink.whl", "archive_info": {}}, "pip install 'aolink[tables]'"),
    ],
)
def test_the_command_names_the_place_that_aolink_was_installed_from(tmp_path, monkeypatch, origin, command):
    metadata = tmp_path / "aolink-0.1.0.dist-info"
    metadata.mkdir()
    (metadata / "METADATA").write_text("Metadata-Version: 2.1\nName: aolink\nVersion: 0.1.0\n")
    if origin is not None:
        (metadata / "direct_url.json").write_text(json.dumps(origin))
    monkeypatch.syspath_prepend(tmp_path)
    assert install_command("tables") == command
