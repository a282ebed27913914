import configparser
import re

import pytest
from conftest import SMALL_CFG

from semfov.detection.darknet_config import Section, parse_cfg, read_cfg
from semfov.errors import DataError


def test_agrees_with_configparser():
    # The standard parser wants unique names of sections.
    count = iter(range(100))
    text = re.sub(r"\[(\w+)\]", lambda match: f"[{next(count)} {match[1]}]", SMALL_CFG)
    parser = configparser.ConfigParser()
    parser.read_string(text)
    sections = parse_cfg(SMALL_CFG)
    assert len(sections) == len(parser.sections())
    for section, name in zip(sections, parser.sections(), strict=True):
        assert section.kind == name.split()[1]
        assert section.options == {key: "".join(value.split()) for key, value in parser[name].items()}
