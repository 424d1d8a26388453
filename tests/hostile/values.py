"""Invalid values for options and files, as attackers and tired users write them."""

from __future__ import annotations

import random
from collections.abc import Sequence

NUMBERS = (
    "nan", "-nan", "inf", "-inf", "1e308", "-1e308", "1e309", "1e-320", "0", "-0", "-1", "0.5", "7", "1e9",
    "99999999999999999999", "-99999999999999999999", "0x10", "1_0", "1,5", "١", "２", "1e", "--1", "true",
)  # fmt: skip
TEXTS = (
    "", " ", "\t", "a\nb", "\x1b[31mred\x1b[0m", "\x7f", "\u202eabc", "é", "日本", "🤖", "e\u0301", "\udcff\udc80",
    "a" * 300, "a" * 70_000, ".", "..", "/", "~", "*", "%s%n%d", "{0}", "{}", "[]", "$HOME", "`id`", "';--", "\\",
    '"', "null", "None", "-", "=", ":", "::", ",", ",,,", "a=b", "a=", "=1", "shoulder=nan", "shoulder=1e400",
    "tip:0,0,0", "tip:nan,0,1", "tip:1,0", "tip:0,0,1:inf", "tip:0,0,1:-1", ":0,0,1", "tip:point:point",
    "tip:nothing", "/dev/null", "/dev/full", "/proc/self/mem", "/nonexistent/a/b", "example-robot-data:",
    "example-robot-data:../../x", "package://nothing/at/all", "file:///etc", "small.urdf/below", "small.urdf\\",
    "tip", "shoulder", "universe", "root_joint", "world_link", "home", "zero", "nothing.toml", "nothing.json",
    "nothing.yaml", "wrong.json", "wrong.toml",
)  # fmt: skip


def value(rng: random.Random) -> str:
    """Return a random number or a random text."""
    return rng.choice(NUMBERS if rng.random() < 0.5 else TEXTS)


TOML = (
    "nan", "-inf", "inf", "0", "-1", "1e308", "1e-320", "1e400", "9223372036854775808", "true", '""', '" "', '"nan"',
    "[]", "[[]]", "{}", "[1]", "[1, 2]", "[1, 2, 3, 4, 5]", '["a"]', "[nan, 0, 1]", "[0, 0, 0]",
    "[1e308, 1e308, 1e308]", '[1, "a", true]', "1979-05-27", "1979-05-27T07:32:00Z", "07:32:00", '"\\u0000"',
    '"\\u001b[31m"', '"日本"', '"../../../etc/passwd"', '"/dev/null"', '"a\\nb"', "{a = 1}", "[{a = 1}]", "[{}]",
    '"tip"', '"shoulder"', '"fixed"', "[" * 40 + "]" * 40, "'''\n\n'''", "0x7fffffffffffffff", "",
)  # fmt: skip


def spoiled(text: str, rng: random.Random, replacements: Sequence[str] = TOML) -> bytes:
    """Return a text file with one to three random faults."""
    lines = text.splitlines()
    for _ in range(rng.choice((1, 1, 1, 2, 3))):
        k, fault = rng.randrange(len(lines)), rng.randrange(9)
        if fault <= 3 and any("=" in line for line in lines):
            k = rng.choice([n for n, line in enumerate(lines) if "=" in line])
            lines[k] = lines[k].partition("=")[0] + "= " + rng.choice(replacements)
        elif fault == 4:
            lines.insert(k, lines[k])
        elif fault == 5 and len(lines) > 1:
            del lines[k]
        elif fault == 6:
            strange = ("stranger = 1", "[stranger]", "[[stranger]]", "= 1", "a.b.c = {", "\x00", "\x1b[2J")
            lines.insert(k, rng.choice(strange))
        else:
            at = rng.randrange(len(lines[k]) + 1)
            inserted = rng.choice(("\ufeff", "\x00", "é", "]", '"', "[" * 3000, "\t", "\x7f"))
            lines[k] = lines[k][:at] if fault == 7 else lines[k][:at] + inserted + lines[k][at:]
    data = "\n".join(lines).encode() + b"\n"
    if rng.random() < 0.1:
        at = rng.randrange(len(data))
        data = data[:at] + rng.choice((b"", b"\xff\xfe" + data[at:], bytes([rng.randrange(256)]) + data[at + 1 :]))
    return data
