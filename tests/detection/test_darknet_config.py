import configparser
import re

import pytest

from semfov.detection.darknet_config import Section, parse_cfg, read_cfg
from semfov.errors import DataError


def test_agrees_with_configparser(small_cfg):
    # The parser of the standard library needs unique section names.
    number = iter(range(100))
    parser = configparser.ConfigParser()
    parser.read_string(re.sub(r"\[(\w+)\]", lambda match: f"[{next(number)} {match[1]}]", small_cfg.read_text()))
    sections = read_cfg(small_cfg)
    assert len(sections) == len(parser.sections()) == 18
    for section, name in zip(sections, parser.sections(), strict=True):
        assert section.kind == name.split()[1]
        assert section.options == {key: "".join(value.split()) for key, value in parser[name].items()}


def test_comments_blanks_and_repeated_keys():
    (section,) = parse_cfg("# net\n ; net\n\n [ net ] \n width = 32 \n width=64\nempty=\n")
    assert section.kind == "net"
    assert section.options == {"width": "32", "empty": ""}
    assert section.where == "cfg:4"


def test_values_are_converted_and_checked():
    section = Section("yolo", {"mask": "1,2,", "anchors": "1.5,2,3,4", "size": "3", "word": "x"}, "a.cfg:7")
    assert section.integers("mask") == (1, 2)
    assert section.numbers("anchors") == (1.5, 2.0, 3.0, 4.0)
    assert section.integer("size") == 3
    assert section.integer("stride", 2) == 2
    with pytest.raises(DataError, match=r"a.cfg:7: \[yolo\] expected the key 'classes', which is missing"):
        section.integer("classes")
    for key in ("mask", "word"):
        with pytest.raises(DataError, match=rf"a.cfg:7: \[yolo\] {key}: expected"):
            section.integer(key)
    with pytest.raises(DataError, match="of at least 4, got '3'"):
        section.integer("size", minimum=4)
    with pytest.raises(DataError, match="expected numbers, got 'x'"):
        section.numbers("word")


@pytest.mark.parametrize("text", ["width=3", "[net]\nwidth 3", "[net"])
def test_refuses_invalid_syntax(text):
    with pytest.raises(DataError, match=r"cfg:\d: expected \[section\] or key=value"):
        parse_cfg(text)


def test_refuses_unreadable_files(tmp_path):
    with pytest.raises(DataError, match=r"cannot read the cfg .*missing.cfg"):
        read_cfg(tmp_path / "missing.cfg")
    binary = tmp_path / "binary.cfg"
    binary.write_bytes(b"\xff\xfe\x00\x9f")
    with pytest.raises(DataError, match="a file that is not text"):
        read_cfg(binary)
