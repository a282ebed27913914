"""The index of the site's search: what a reader looks for is a task before it is a name in the code."""

import json
import re
from pathlib import Path


def put_pages_first(index: Path) -> None:
    """Make members part of the entry of their class, and leave out source files and what is not public.

    A member such as `thresholds`, or a file such as `examples/ros_node.py`, has a word for a title, which no page about
    thresholds or ROS outranks. The words of a member lead to its class, and those of a file, or of a name on the page
    of internals, to the pages that link it.

    Args:
        index: the file of the index, whose entries follow the order of the pages; it is written anew.
    """
    found = json.loads(index.read_text(encoding="utf-8"))
    items: list[dict[str, object]] = []
    for item in found["items"]:
        name = re.sub(r"\s*<.*", "", str(item["title"]))
        is_member = str(item["location"]).startswith("api/") and "#" in str(item["location"]) and "." not in name
        if str(item["location"]).partition("#")[0].endswith((".py.html", "api/internals.html")):
            continue
        if is_member:
            items[-1]["text"] = f"{items[-1]['text']}<p>{name}</p>{item['text']}"
        else:
            items.append(item)
    found["items"] = items
    index.write_text(json.dumps(found, ensure_ascii=False), encoding="utf-8")
