"""`cell console`: the link to its page is nowhere where others of this computer see it."""

from pathlib import Path

import pytest

from cell.apps.cli.commands.console import page_notifier, require_installed
from drivers.errors import ConfigError


def test_the_link_is_in_no_process_s_arguments(monkeypatch):
    """The browser is given a file that nobody else may read, in a folder that nobody else may enter."""
    opened: list[str] = []
    monkeypatch.setattr("webbrowser.open", opened.append)
    notify = page_notifier(open_page=True)
    for link in ("http://127.0.0.1:1/enter?token=first", "http://127.0.0.1:1/enter?token=second"):
        notify(link)
    (url,) = opened
    page = Path(url.removeprefix("file://"))
    assert "token" not in url and "token=first" in page.read_text()
    assert [path.stat().st_mode & 0o077 for path in (page, page.parent)] == [0, 0]


def test_without_its_server_s_packages_it_says_what_to_install(monkeypatch):
    monkeypatch.setattr("importlib.util.find_spec", lambda name: None)
    with pytest.raises(ConfigError, match=r"websockets; in the checkout: pip install -e '\.\[console\]'"):
        require_installed()
