"""No text that is printed can command the terminal."""

import io
import re
from pathlib import Path

import matplotlib
import pytest
from rich.table import Table
from rich.text import Text

import p2gs_jax
from p2gs_jax.core.progress import PlainConsole
from p2gs_jax.core.text import markdown_table, printable
from p2gs_jax.jobs.job import ProgressFile
from p2gs_jax.run.plots import names_as_they_are


@pytest.mark.parametrize(
    ("text", "shown"),
    [
        ("plain é 照片\n\ttwo", "plain é 照片\n\ttwo"),
        ("\x1b[31mred", "\\x1b[31mred"),
        ("a\rb\x07\x7f", "a\\rb\\x07\\x7f"),
        ("\x9b31m", "\\x9b31m"),
        ("\u202egnp", "\\u202egnp"),
        ("\udcff", "\\udcff"),
    ],
)
def test_control_characters_are_written_out(text, shown):
    assert printable(text) == shown
    assert printable(shown) == shown


def test_cells_of_markdown_are_text():
    table = markdown_table(["", "a|b"], [["<b>`x`", "![y](http://z)\n| --- |\x1b"]])
    first, rule, second = table.splitlines()
    assert first == r"|  | a\|b |"
    assert rule == "| --- | ---: |"
    assert second == r"| \<b\>\`x\` | !\[y\](http://z) \| --- \|\\x1b |"


def printed(thing) -> str:
    file = io.StringIO()
    PlainConsole(file=file, force_terminal=True, color_system="truecolor", width=60).print(thing)
    return file.getvalue()


def test_a_terminal_gets_colours_and_no_control_characters():
    table = Table("\x1b]0;title\x07")
    table.add_row(Text("\x1b[31mred", style="bold"))
    for thing in ("\x1b[31mred", Text("\x1b[31mred"), table):
        assert "\x1b[31m" not in printed(thing)
        assert "\x1b]0" not in printed(thing)
        assert "\\x1b" in printed(thing)
    assert "\x1b[1m" in printed(Text("bold", style="bold"))
    for name in ("[bold]x[/bold]", "[/nothing].png", ":smile:"):
        assert printed(name).strip() == name


def test_settings_of_matplotlib_do_not_change_pictures():
    """matplotlib reads a `matplotlibrc` of the working folder, which may be a scene's."""
    with matplotlib.rc_context({"text.usetex": True, "axes.facecolor": "red"}):
        with names_as_they_are():
            drawn = [matplotlib.rcParams[name] for name in ("text.usetex", "text.parse_math")]
        assert matplotlib.rcParams["text.usetex"]
    assert drawn == [False, False]


def test_every_console_and_message_of_a_worker_is_plain(tmp_path, capsys):
    for path in Path(p2gs_jax.__file__).parent.rglob("*.py"):
        made = re.findall(r"(?<!class )\b\w*Console\(", path.read_text(encoding="utf-8"))
        assert set(made) <= {"PlainConsole("}, path
    ProgressFile(tmp_path / "progress.json").message("\x1b[31mred")
    assert capsys.readouterr().out == "\\x1b[31mred\n"


def test_errors_are_printable(refused, tmp_path):
    red = tmp_path / "\x1b[31mred"
    # The second is a superfluous argument, as a shell's pattern may add.
    for words, shown in (([red], "red does not exist"), ([tmp_path, "\x1b[31mred"], "red")):
        text = refused("inspect", *words)
        assert f"\\x1b[31m{shown}" in text
        assert "\x1b" not in text
