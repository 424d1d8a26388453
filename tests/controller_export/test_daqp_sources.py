"""Sources of DAQP: download, checks, and one-line errors."""

from __future__ import annotations

import io
import shutil
import subprocess
import tarfile
from pathlib import Path

import pytest

from impact_posture.controller_export import daqp_sources as module
from impact_posture.controller_export.daqp_sources import FILES, SOURCES, VERSION, daqp_sources
from impact_posture.errors import InputError
from impact_posture.system.libraries import building, hash_path
from tests.support.daqp import sources_or_skip


@pytest.fixture
def cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Provide an empty cache and block the network."""
    monkeypatch.setenv("IMPACT_POSTURE_CACHE", str(tmp_path / "cache"))
    monkeypatch.setenv("PIP_NO_INDEX", "1")
    monkeypatch.setenv("PIP_FIND_LINKS", str(tmp_path / "nothing"))
    return tmp_path / "cache"


def archive(path: Path, **members: tarfile.TarInfo | bytes) -> None:
    """Write a source distribution in which each given member contains only one byte; an _ in a name means a dot."""
    with tarfile.open(path, "w:gz") as tar:
        for name, place in FILES.items():
            entry = members.get(name.replace(".", "_"), b"?")
            info = entry if isinstance(entry, tarfile.TarInfo) else tarfile.TarInfo()
            info.name = f"daqp-{VERSION}/{place}"
            if isinstance(entry, bytes):
                info.size = len(entry)
            tar.addfile(info, io.BytesIO(entry if isinstance(entry, bytes) else b""))


def in_cache(cache: Path, **members: tarfile.TarInfo | bytes) -> None:
    cache.mkdir(mode=0o700)
    with building(cache / f"daqp-{VERSION}.tar.gz") as folder:
        archive(folder / f"daqp-{VERSION}.tar.gz", **members)


def test_no_pip_is_one_line(cache: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("importlib.util.find_spec", lambda name: None)
    with pytest.raises(InputError, match="pip is missing"):
        daqp_sources()


LINK = tarfile.TarInfo()
LINK.type, LINK.linkname = tarfile.SYMTYPE, "/etc/passwd"


@pytest.mark.parametrize(
    ("members", "message"),
    [
        ({}, "is not DAQP"),
        ({"daqp_c": LINK}, r"has no file csrc/src/daqp\.c"),
        ({"types_h": bytes(2 << 20)}, r"has no file csrc/include/types\.h"),
    ],
    ids=["contents", "link", "size"],
)
def test_an_archive_with_other_files_is_refused(
    cache: Path, members: dict[str, tarfile.TarInfo | bytes], message: str
) -> None:
    in_cache(cache, **members)
    with pytest.raises(InputError, match=message):
        daqp_sources()


def test_a_file_with_its_hash_that_is_not_an_archive(cache: Path) -> None:
    cache.mkdir(mode=0o700)
    with building(cache / f"daqp-{VERSION}.tar.gz") as folder:
        (folder / f"daqp-{VERSION}.tar.gz").write_bytes(b"no archive")
    with pytest.raises(InputError, match=r"cannot be read.*delete it"):
        daqp_sources()


def test_an_archive_without_its_hash_is_loaded_again(cache: Path) -> None:
    in_cache(cache)
    hash_path(cache / f"daqp-{VERSION}.tar.gz").write_text("0" * 64)
    with pytest.raises(InputError) as caught:
        daqp_sources()
    assert "cannot be downloaded" in caught.value.line and "`daqp`" in caught.value.hint
    assert "\n" not in caught.value.line
    assert not list(cache.glob("*.tar.gz"))


def test_given_folders(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="has no file"):
        daqp_sources(tmp_path / "nowhere")
    sources = sources_or_skip()
    for name, content in sources.items():
        (tmp_path / name).write_bytes(content)
    assert daqp_sources(tmp_path) == sources
    (tmp_path / "daqp.c").write_bytes(sources["daqp.c"] + b"\n")
    with pytest.raises(InputError, match="is not DAQP"):
        daqp_sources(tmp_path)
    (tmp_path / "LICENSE").unlink()
    with pytest.raises(InputError, match="has no file LICENSE"):
        daqp_sources(tmp_path)


def test_the_sources_link_on_their_own(tmp_path: Path) -> None:
    for name, content in sources_or_skip().items():
        (tmp_path / name).write_bytes(content)
    if not shutil.which("cc"):
        pytest.skip("no C compiler")
    command = ["cc", "-std=c99", "-O0", "-fPIC", "-shared", "-Wl,--no-undefined", *SOURCES, "-o", "daqp.so", "-lm"]
    subprocess.run(command, cwd=tmp_path, check=True)
    assert module.SOURCES == tuple(sorted(module.SOURCES))
