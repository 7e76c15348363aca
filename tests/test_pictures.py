"""The pictures of the pages: each has its commands, and every command is one that exists."""

import importlib.util
import re
from pathlib import Path

import pytest
from PIL import Image

from sb3_quad.cli.app import make_parser
from sb3_quad.evaluation.tables import COLOURS, colours_of

ROOT = Path(__file__).resolve().parent.parent
SPEC = importlib.util.spec_from_file_location("pictures", ROOT / "docs/pictures.py")
pictures = importlib.util.module_from_spec(SPEC)
SPEC.loader.exec_module(pictures)


def test_every_picture_of_a_page_has_its_commands():
    kept = {path.name for path in (ROOT / "docs").iterdir() if path.suffix in (".png", ".webp")}
    pages = [ROOT / "README.md", *(ROOT / "docs").rglob("*.md")]
    text = "\n".join(page.read_text(encoding="utf-8") for page in pages)
    shown = {Path(name).name for name in re.findall(r"!\[[^]]*\]\(([^):]+)\)", text)}
    assert kept == shown == set(pictures.PICTURES)


@pytest.mark.parametrize("name", pictures.PICTURES)
def test_commands_of_a_picture_are_those_of_the_package_and_end_with_it(name):
    commands = pictures.commands(pictures.PICTURES[name])
    assert commands[-1][-1] == name
    for program, *arguments in commands:
        if program == "sb3-quad":
            make_parser().parse_args(arguments)
        elif program == "python":
            assert (ROOT / arguments[0]).is_file()
        else:
            assert program in ("cp", "frame")


def test_a_kept_folder_is_made_once(tmp_path, monkeypatch, capsys):
    ran = []
    monkeypatch.setattr(pictures, "BUILD", tmp_path / "build")
    monkeypatch.setattr(pictures, "FINISHED", tmp_path / "build/finished.txt")

    def run(words):
        ran.append(words[1])
        for name in ("side_hit_paths.png", "side_hit_size.png"):
            (tmp_path / "build" / name).write_bytes(b"drawn")

    monkeypatch.setattr(pictures, "run", run)
    names = ["side_hit_paths.png", "side_hit_size.png"]
    monkeypatch.setattr("sys.argv", ["pictures.py", *names, "--into", str(tmp_path / "docs")])
    pictures.main()
    pictures.main()
    assert ran.count("evaluate") == 1 and len(ran) == 5
    assert (tmp_path / "docs" / names[1]).read_bytes() == b"drawn"


def test_an_unknown_picture_is_named(monkeypatch, capsys):
    monkeypatch.setattr("sys.argv", ["pictures.py", "sarts.png"])
    with pytest.raises(SystemExit):
        pictures.main()
    assert "sarts.png" in capsys.readouterr().err


def test_eight_controllers_have_colours_of_their_own():
    many = colours_of([f"agent {number}" for number in range(9)])
    assert [*many.values()] == [*COLOURS, COLOURS[0]]


def test_a_frame_of_a_film_is_a_picture(tmp_path):
    frames = [Image.new("RGB", (8, 6), colour) for colour in ("red", "blue", "lime")]
    frames[0].save(tmp_path / "f.gif", save_all=True, append_images=frames[1:])
    pictures.frame(tmp_path / "f.gif", 1, tmp_path / "f.png")
    assert Image.open(tmp_path / "f.png").getpixel((0, 0)) == (0, 0, 255)
