"""A browser shows report.html of a robot with hostile names as plain text, without scripts, requests or overflow.

``--hostile-full`` tries all names.
"""

from __future__ import annotations

import html
from pathlib import Path

import pytest

from impact_posture.errors import printable
from impact_posture.output import plot
from tests.hostile.arena import SMALL, judging, strike
from tests.support.browser import browser

SCRIPT = "<script>document.title='taken'</script>"
NAMES = {
    "script": f"</script>{SCRIPT}<img src=x onerror=\"document.title='taken'\">",
    "all": f"\u202eab</title></style></textarea></template></noscript>--!>]]>{SCRIPT}é日本🤖e\u0301",
    "comment": f"<!--<script>{SCRIPT}",
    "attribute": "\" autofocus onfocus=\"document.title='taken'\" x='",
    "template": "{{ 7 * 7 }}${document.title='taken'}`{%raw%}",
    "svg": "<svg onload=\"document.title='taken'\"><foreignObject>",
    "link": "javascript:document.title='taken'",
    "request": '<link rel=stylesheet href="http://example.invalid/x.css"><base href="http://example.invalid/">',
    "refresh": '<meta http-equiv="refresh" content="0;url=http://example.invalid/">',
    "prototype": "__proto__",
    "constructor": "constructor",
    "number": "0",
    "mathjax": "\\(x\\) $x^2$ \\[\\href{javascript:alert(1)}{x}\\]",
    "markdown": "[x](http://example.invalid) | **b** `c` \\| ",
    "entity": "&lt;b&gt; &amp; &#60;script&#62;",
    "right to left": "\u202e\u2066\u202dשלום\u200f عربي",
    "long": "x" * 10_000,
    "long words": "word " * 2_000 + "end",
    "combining": "a" + "\u0301" * 500,
    "separators": "a\u2028b\u2029c\u0085d\ufeff",
}
QUICK = ("script",)


def robot(name: str) -> str:
    """Return the URDF of the small robot with hostile names of robot, links and joints."""
    text = SMALL
    for old in ("small", "upper", "lower", "tip", "shoulder", "elbow", "wrist"):
        new = html.escape(f"{name}{old}" if name not in ("__proto__", "constructor", "0") or old != "elbow" else name)
        text = text.replace(f'"{old}"', f'"{new}"')
    return text


@pytest.mark.parametrize("name", NAMES)
def test_names_in_a_browser(name: str, arena: Path, hostile_full: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    if name not in QUICK and not hostile_full:
        pytest.skip("more names on pages: give --hostile-full")
    text = NAMES[name]
    (arena / "bad.urdf").write_text(robot(text), encoding="utf-8")
    only = {"jump": plot.FIGURES["jump"]}
    monkeypatch.setattr(plot, "FIGURES", only)
    argv = ("optimize", "bad.urdf", "--frame", f"{text}tip", "--normal", "1", "0", "0.3", "--contact-pose", "free")
    outcome = strike(arena, *argv, "--starts", "1", "--no-codegen", "--format", "svg", "--out", "out", "--quiet")
    assert (outcome.code, outcome.complaints) == (0, []), outcome.err[-500:]
    with browser(arena / "profile") as tab, judging() as judge:
        tab.open(arena / "out" / "report.html")
        complaints = tab.complaints()
        complaints += ["a script ran"] if tab.evaluate("document.title") == "taken" else []
        tab.evaluate("document.getElementById('end').click()")
        for width in (1280, 360):
            tab.resize(width, 640)
            wide = tab.evaluate("document.documentElement.scrollWidth")
            complaints += [f"{wide} pixels wide on a screen of {width}"] if wide > width else []
        shown = tab.evaluate("document.body.textContent")
        complaints += [] if printable(text[:9]).split()[0] in shown else ["the name is not shown"]
        judge(name, complaints + tab.complaints(), 0)
