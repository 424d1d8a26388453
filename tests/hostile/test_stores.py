"""If the stored files of a finished run were changed, the run runs again or gives an error, even if the checksums
match.

``--hostile-full`` tries many more changes.
"""

from __future__ import annotations

import hashlib
import io
import json
import os
import random
import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from matplotlib.figure import Figure

import impact_posture.experiment.experiment_folders as folders
from impact_posture.experiment.reproduction import reproduce
from tests.hostile.arena import judging, strike, write_short_scenario
from tests.simulation.factories import needs_mujoco

COUNT = 2
STORE = ".cmp.runs"
COMPARE = ("compare", "short.toml", "--controllers", "nominal,invariant", "--seeds", "1", "--compile", "never")
VALUES = (None, [], {}, "a", -1, 10**400, 1e308, float("nan"), [1.0], [[None]] * 3, True, "\0", "../../x", {"a": {}})


@pytest.fixture(scope="module")
def finished(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    """A folder with a short scenario and the store of its finished runs."""
    needs_mujoco()
    folder = tmp_path_factory.mktemp("finished")
    write_short_scenario(folder)
    with pytest.MonkeyPatch.context() as patch:
        # Jobs are stored with the path as it is typed.
        patch.chdir(folder)
        patch.setattr(folders, "figures_of_comparison", lambda views: {"snapshots": Figure(figsize=(1, 1))})
        with folders.store_beside(folder / "cmp") as store:
            reproduce({"short.toml": ["nominal", "invariant"]}, seeds=1, store=store, compile="never")
        yield folder


def spoil_document(store: Path, rng: random.Random) -> None:
    """Change a value of a document at a random depth, and write the new checksum."""
    path = rng.choice(sorted(store.glob("*.json")))
    content = json.loads(path.read_text().partition("\n")[2])
    at: Any = content
    while isinstance(at, dict | list) and at:
        key: Any = rng.choice(sorted(at)) if isinstance(at, dict) else rng.randrange(len(at))
        if not isinstance(at[key], dict | list) or rng.random() < 0.25:
            at[key] = rng.choice(VALUES)
            if rng.random() < 0.3:
                del at[key]
            break
        at = at[key]
    text = json.dumps(content)
    path.write_text(f"{hashlib.sha256(text.encode()).hexdigest()}\n{text}")


def spoil_series(store: Path, rng: random.Random) -> None:
    """Change an array of a time series, and write the new checksums."""
    path = rng.choice(sorted(store.glob("*.npz")))
    with np.load(path) as file:
        arrays = dict(file)
    name = rng.choice(sorted(arrays))
    wrong = (np.zeros(0), arrays[name][:-1], np.full(arrays[name].shape, np.nan), np.array(["a"]), np.array(1j),
             np.zeros((2, 2, 2)), arrays[name] * 0 + 1e300)  # fmt: skip
    arrays[name] = wrong[rng.randrange(len(wrong))]
    sink = io.BytesIO()
    np.savez(sink, **arrays)
    data = rng.choice((sink.getvalue(), sink.getvalue(), sink.getvalue()[:-50], b"", b"PK\3\4"))
    path.write_bytes(data)
    document = path.with_suffix(".json")
    content = json.loads(document.read_text().partition("\n")[2])
    content["series"]["1"] = hashlib.sha256(data).hexdigest()
    text = json.dumps(content)
    document.write_text(f"{hashlib.sha256(text.encode()).hexdigest()}\n{text}")


def spoil_entry(store: Path, rng: random.Random) -> None:
    """Damage the bytes of a file, exchange files, or put something else in their places."""
    paths = sorted(store.iterdir())
    path, other = rng.choice(paths), rng.choice(paths)
    kind, data = rng.randrange(7), path.read_bytes()
    if kind == 0:
        at = rng.randrange(len(data))
        path.write_bytes(data[:at] + bytes([data[at] ^ 1]) + data[at + 1 :])
    elif kind == 1:
        path.write_bytes(other.read_bytes())
    else:
        path.unlink()
        if kind == 2:
            path.mkdir()
        elif kind == 3:
            os.mkfifo(path)
        elif kind == 4:
            path.symlink_to(rng.choice(("/dev/zero", path.name, "/nowhere", other.name)))
        elif kind == 5:
            path.write_bytes(data[: rng.randrange(len(data))])


@pytest.mark.parametrize("spoil", [spoil_document, spoil_series, spoil_entry], ids=lambda function: function.__name__)
def test_changed_stores(spoil: Any, finished: Path, hostile_full: bool) -> None:
    rng = random.Random(spoil.__name__)
    with judging() as judge:
        for k in range(COUNT * (80 if hostile_full else 1)):
            work = finished.parent / "work"
            shutil.rmtree(work, ignore_errors=True)
            shutil.copytree(finished, work)
            if k:
                spoil(work / STORE, rng)
            outcome = strike(work, *COMPARE, "--no-report", "--quiet", "--out", "cmp")
            complaints = [fault for fault in outcome.complaints if "fails and leaves" not in fault]
            if outcome.code == 0:
                text = (work / "cmp" / "comparison.json").read_text()
                complaints += ["NaN in the result"] if "NaN" in text else []
            judge(f"change {k}: {outcome.code} {outcome.err[-300:]!a}", complaints, 0)
