"""Damaged shards and manifests are noticed, named, and written again with the same content.

``--hostile-full`` continues the sweep after every single damage.
"""

from __future__ import annotations

import json
import os
import random
import shutil
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pyarrow as pa
import pytest
from pyarrow import parquet

import impact_posture as ip
from impact_posture.errors import ImpactPostureError, OutputError, SpecError
from impact_posture.sweep.atlas import Atlas, sweep_key
from impact_posture.sweep.maps import draw_maps
from impact_posture.sweep.sweep_file import Sweep, read_sweep
from impact_posture.sweep.sweep_run import run_sweep
from impact_posture.system.sealed_files import UNSEALED, sealed
from tests.support.command import run

TEXT = """
shard = 3
[problem]
robot = "tilthex_arm"
starts = 1
[grid]
normal = [[0, 0, 1], [0, 0.6, 0.8]]
speed = [0.5, 1, 2, 4]
"""
COUNT = 40
# Values that replace a value of a manifest.
STRANGE = (
    None, True, -1, 0, 1e308, 10**400, float("nan"), "", "a", "\0\x1b[31m", "[problem]", [], [[]], [1.0, [2.0]],
    {}, {"a": 1}, json.loads("[" * 500 + "]" * 500),
)  # fmt: skip


@pytest.fixture(scope="module")
def solved(tmp_path_factory: pytest.TempPathFactory) -> tuple[Sweep, str, Path]:
    """Return a sweep, its key, and its folder with three shards."""
    folder = tmp_path_factory.mktemp("solved")
    (folder / "sweep.toml").write_text(TEXT)
    sweep = read_sweep(folder / "sweep.toml")
    run_sweep(sweep, folder / "out")
    return sweep, sweep_key(sweep), folder / "out"


def shards(folder: Path) -> list[Path]:
    return sorted(folder.glob("data/*/*.parquet"))


def contents(folder: Path) -> dict[str, bytes]:
    return {p.name: p.read_bytes() for p in (folder / "manifest.json", *shards(folder))}


def entries(block: Any) -> Iterator[tuple[Any, Any]]:
    """Yield each table and list of a document with each of its keys."""
    if isinstance(block, dict | list):
        for key in block if isinstance(block, dict) else range(len(block)):
            yield block, key
            yield from entries(block[key])


# ---- kinds of damage: a function changes the content of a shard, or of a second shard ------------------------------


def flip(content: bytes, rng: random.Random) -> bytes:
    at = rng.randrange(len(content))
    return content[:at] + bytes([content[at] ^ 1 << rng.randrange(8)]) + content[at + 1 :]


def cut(content: bytes, rng: random.Random) -> bytes:
    return content[: rng.randrange(len(content))]


def lose(content: bytes, rng: random.Random) -> bytes:
    at, size = rng.randrange(len(content)), rng.randrange(1, 300)
    return content[:at] + content[at + size :]


def blank(content: bytes, rng: random.Random) -> bytes:
    """Overwrite a column chunk by zeros, as a lost block of a disk."""
    group = parquet.read_metadata(pa.BufferReader(content)).row_group(0)
    column = group.column(rng.randrange(group.num_columns))
    first = column.dictionary_page_offset or column.data_page_offset
    return content[:first] + bytes(column.total_compressed_size) + content[first + column.total_compressed_size :]


def rewrite(content: bytes, change: Callable[[pa.Table], pa.Table]) -> bytes:
    """Write the table again, with its metadata."""
    sink = pa.BufferOutputStream()
    parquet.write_table(change(parquet.read_table(pa.BufferReader(content))), sink, compression="zstd")
    return bytes(sink.getvalue())


def repeat(content: bytes, rng: random.Random) -> bytes:
    row = rng.randrange(2)
    return rewrite(content, lambda table: pa.concat_tables([table, table.slice(row, 1)]))


def exchange(content: bytes, rng: random.Random) -> bytes:
    return rewrite(content, lambda table: table.take([1, 0, *range(2, table.num_rows)]))


def of_another_sweep(content: bytes, rng: random.Random) -> bytes:
    key = parquet.read_metadata(pa.BufferReader(content)).metadata[b"sweep"]
    return sealed(content.replace(key, bytes(reversed(key))))


def of_no_sweep(content: bytes, rng: random.Random) -> bytes:
    return sealed(b"sha256:" + bytes(64 + rng.randrange(100)))


CHANGES = (flip, flip, flip, cut, lose, blank, repeat, exchange, of_another_sweep, of_no_sweep)


def damage(folder: Path, rng: random.Random) -> list[str]:
    """Damage a random shard, or swap two shards; return the paths below the folder of the damaged shards."""
    first, second = rng.sample(shards(folder), 2)
    if rng.random() < 0.15:
        contents = first.read_bytes(), second.read_bytes()
        for path, content in zip((second, first), contents, strict=True):
            path.write_bytes(content)
        return sorted(path.relative_to(folder).as_posix() for path in (first, second))
    first.write_bytes(rng.choice(CHANGES)(first.read_bytes(), rng))
    return [first.relative_to(folder).as_posix()]


def test_every_damage_is_noticed(solved: tuple[Sweep, str, Path], tmp_path: Path, hostile_full: bool) -> None:
    sweep, key, folder = solved
    rng, wanted = random.Random(40), contents(folder)
    shutil.copytree(folder, tmp_path / "out")
    for k in range(COUNT):
        damaged = damage(tmp_path / "out", rng)
        with pytest.raises(SpecError, match="damaged shards") as caught:
            ip.sweep.open(tmp_path / "out")
        assert all(name.removeprefix("data/") in caught.value.what for name in damaged)
        atlas = Atlas(tmp_path / "out", sweep, key)
        with atlas.opened():
            assert len(atlas.waiting()[1]) == len(damaged) and sorted(atlas.damaged) == damaged
        # Continuing the sweep takes long, and does not depend on the kind of damage.
        if k % 10 == 0 or hostile_full:
            again = run_sweep(sweep, tmp_path / "out")
            assert again.damaged == tuple(damaged) and again.shards == len(damaged)
            assert contents(tmp_path / "out") == wanted
        for path in shards(tmp_path / "out"):
            path.write_bytes(wanted[path.name])


@pytest.mark.parametrize("place", ["data", "first-pass"])
def test_a_damaged_shard_of_the_first_pass_is_solved_again(
    place: str, solved: tuple[Sweep, str, Path], tmp_path: Path
) -> None:
    sweep, _, folder = solved

    def stop(done: int, count: int) -> None:
        if done > 8 and done < count:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        run_sweep(sweep, tmp_path / "out", progress=stop)
    # The second pass of the first shard is over.
    (path,) = (tmp_path / "out" / place).glob(f"*/shard-{'000000' if place == 'first-pass' else '000001'}.parquet")
    path.write_bytes(blank(path.read_bytes(), random.Random(1)))
    again = run_sweep(sweep, tmp_path / "out")
    assert again.damaged == (path.relative_to(tmp_path / "out").as_posix(),)
    assert contents(tmp_path / "out") == contents(folder)


def test_the_command_names_damaged_files(solved: tuple[Sweep, str, Path], tmp_path: Path) -> None:
    shutil.copytree(solved[2], tmp_path / "out")
    (tmp_path / "sweep.toml").write_text(TEXT)
    path = shards(tmp_path / "out")[1]
    path.write_bytes(flip(path.read_bytes(), random.Random(2)))
    shown = run("sweep", "show", "out", cwd=tmp_path)
    assert shown.returncode == 1
    assert shown.stderr == (
        "error: out: has damaged shards (case=0/shard-000001.parquet); "
        "run sweep again to solve these shards again, and move away files that sweep did not write\n"
    )
    again = run("sweep", "sweep.toml", "--out", "out", "--workers", "1", cwd=tmp_path)
    warning = "warning: data/case=0/shard-000001.parquet was damaged or belonged to another sweep; it was rewritten\n"
    assert (again.returncode, again.stderr) == (0, warning)
    assert contents(tmp_path / "out") == contents(solved[2])


def test_pages_are_checked_when_they_are_read(solved: tuple[Sweep, str, Path], tmp_path: Path) -> None:
    """The file is damaged after it was opened."""
    shutil.copytree(solved[2], tmp_path / "out")
    table, path = ip.sweep.open(tmp_path / "out"), shards(tmp_path / "out")[0]
    content = path.read_bytes()
    column = parquet.read_metadata(path).row_group(0).column(1)
    at = column.data_page_offset + column.total_compressed_size - 1
    path.write_bytes(content[:at] + bytes([content[at] ^ 1]) + content[at + 1 :])
    with pytest.raises(OSError, match=r"(?i)crc"):
        table.to_table()


# ---- manifests -----------------------------------------------------------------------------------------------------


def test_a_damaged_manifest_is_written_again(solved: tuple[Sweep, str, Path], tmp_path: Path) -> None:
    sweep, _, folder = solved
    shutil.copytree(folder, tmp_path / "out")
    path = tmp_path / "out" / "manifest.json"
    path.write_text(path.read_text().replace("0.6", "0.7"))
    with pytest.raises(SpecError, match="damaged") as caught:
        ip.sweep.open(tmp_path / "out")
    assert caught.value.where == str(path)
    again = run_sweep(sweep, tmp_path / "out")
    assert (again.damaged, again.shards) == (("manifest.json",), 0)
    assert contents(tmp_path / "out") == contents(folder)


@pytest.mark.parametrize("what", ["shards", "another sweep", "a foreign file", "a damaged shard"])
def test_a_folder_without_its_manifest(what: str, solved: tuple[Sweep, str, Path], tmp_path: Path) -> None:
    """Only files whose checksums prove that they are shards are used, or removed by force."""
    sweep, key, folder = solved
    out = Path(shutil.copytree(folder, tmp_path / "out"))
    (out / "manifest.json").unlink()
    if what == "a foreign file":
        (out / "data" / "notes.txt").write_text("mine")
    elif what == "a damaged shard":
        shards(out)[0].write_bytes(flip(shards(out)[0].read_bytes(), random.Random(1)))
    before = {path: path.read_bytes() for path in out.rglob("*") if path.is_file()}
    new = Atlas(out, sweep, "another" if what == "another sweep" else key)
    if what != "shards":
        with pytest.raises(OutputError, match="exists"), new.opened():
            pass
    if what in ("a foreign file", "a damaged shard"):
        with pytest.raises(OutputError, match="data/, which this command did not write"), new.opened(force=True):
            pass
        assert before == {path: path.read_bytes() for path in out.rglob("*") if path.is_file()}
        return
    with new.opened(force=what == "another sweep"):
        assert len(new.waiting()[1]) == (0 if what == "shards" else sweep.shards)
    assert new.damaged == {"manifest.json"} and len(shards(out)) == (sweep.shards if what == "shards" else 0)


def sealed_text(manifest: Any) -> str:
    """Return the text of a changed manifest with its right checksum."""
    if isinstance(manifest, dict) and "checksum" in manifest:
        manifest["checksum"] = UNSEALED
    return sealed(json.dumps(manifest).encode()).decode()


def test_changed_manifests_end_in_one_line(
    solved: tuple[Sweep, str, Path], tmp_path: Path, hostile_full: bool
) -> None:
    """Half of the manifests have a valid checksum, so that the table of their keys is tested."""
    folder, refused = Path(shutil.copytree(solved[2], tmp_path / "out")), 0
    text, rng = (folder / "manifest.json").read_text(), random.Random(5)
    for _ in range(300 if hostile_full else 30):
        manifest = json.loads(text)
        block, key = rng.choice(list(entries(manifest)))
        block[key] = rng.choice(STRANGE)
        if rng.random() < 0.2:
            del block[key]
        changed = sealed_text(manifest) if rng.random() < 0.5 else json.dumps(manifest)
        (folder / "manifest.json").write_text(changed)
        try:
            draw_maps(folder, tmp_path / "maps")
        except ImpactPostureError as error:
            refused += 1
            assert "\n" not in error.line and len(error.line) < 2000 and str(folder) in error.line
        try:
            run_sweep(solved[0], folder)
        except ImpactPostureError as error:
            assert "\n" not in error.line and str(folder) in error.line
        else:
            assert (folder / "manifest.json").read_text() == text
    assert refused >= 25


def test_folders_without_checksums_are_still_read(solved: tuple[Sweep, str, Path], tmp_path: Path) -> None:
    """Version 0.2 wrote folders of schema 1."""
    shutil.copytree(solved[2], tmp_path / "out")
    path = tmp_path / "out" / "manifest.json"
    manifest = json.loads(path.read_text())
    del manifest["checksum"]
    path.write_text(json.dumps(manifest | {"schema": "impact-posture/sweep-folder/1", "version": "0.2.0"}))
    for shard in shards(tmp_path / "out"):
        shard.write_bytes(rewrite(shard.read_bytes(), lambda table: table.replace_schema_metadata({"sweep": "key"})))
    assert ip.sweep.open(tmp_path / "out").count_rows() == 8
    first = shards(tmp_path / "out")[0]
    content = first.read_bytes()
    first.write_bytes(content[:4] + bytes(400) + content[404:])
    with pytest.raises(SpecError, match="cannot be read"):
        draw_maps(tmp_path / "out", tmp_path / "maps")


def test_a_pipe_in_the_place_of_a_shard(solved: tuple[Sweep, str, Path], tmp_path: Path) -> None:
    sweep, _, folder = solved
    shutil.copytree(folder, tmp_path / "out")
    path = shards(tmp_path / "out")[1]
    path.unlink()
    os.mkfifo(path)
    with pytest.raises(SpecError, match="pipe or a device"):
        ip.sweep.open(tmp_path / "out")
    run_sweep(sweep, tmp_path / "out")
    assert contents(tmp_path / "out") == contents(folder)
