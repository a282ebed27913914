"""The index of the site's search: what a reader looks for is a task before it is a name in the code."""

import json
import re
from pathlib import Path


def put_members_into_classes(index: Path) -> None:
    """Make the entries of methods and properties part of the entry of their class.

    A member such as `thresholds` has one word for a title, which no page about thresholds outranks. Its text, and so
    each of its words, leads to its class.

    Args:
        index: the file of the index, whose entries follow the order of the pages; it is written anew.
    """
    found = json.loads(index.read_text(encoding="utf-8"))
    items: list[dict[str, object]] = []
    for item in found["items"]:
        name = re.sub(r"\s*<.*", "", str(item["title"]))
        is_member = str(item["location"]).startswith("api/") and "#" in str(item["location"]) and "." not in name
        if is_member:
            items[-1]["text"] = f"{items[-1]['text']}<p>{name}</p>{item['text']}"
        else:
            items.append(item)
    found["items"] = items
    index.write_text(json.dumps(found, ensure_ascii=False), encoding="utf-8")
