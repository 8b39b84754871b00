"""XML files of poses as the maps and lists that a JSON file would hold: OpenCV's storage, ViSP's, an arm's own export.

Elements of one name are a list; an element's text is a number, several numbers, or words.
"""

from __future__ import annotations

import re
from typing import Any
from xml.etree import ElementTree


def read_xml(text: str) -> Any:
    """The maps, lists, numbers and words of a text. Raises ValueError."""
    if "<!ENTITY" in text or "<!DOCTYPE" in text:
        raise ValueError("it is more of XML than is read here (entities)")
    try:
        root = ElementTree.fromstring(re.sub(r"^\s*<\?xml[^>]*\?>", "", text))
    except ElementTree.ParseError as error:
        raise ValueError(f"it is no XML: {error}") from error
    return {root.tag: _value(root)}


def _value(element: ElementTree.Element) -> Any:
    parts: dict[str, list[Any]] = {}
    for key, value in element.attrib.items():
        parts.setdefault(key, []).append(_scalar(value))
    for child in element:
        parts.setdefault(child.tag, []).append(_value(child))
    # An attribute beside a text says what the text is (type_id); beside none it is what the element holds.
    if parts and (len(element) or not (element.text or "").strip()):
        return {key: values[0] if len(values) == 1 else values for key, values in parts.items()}
    return _scalar(element.text or "")


def _scalar(text: str) -> Any:
    words = text.split()
    try:
        numbers = [float(word) for word in words]
    except ValueError:
        return text.strip()
    if len(numbers) == 1:
        return int(numbers[0]) if re.fullmatch(r"[-+]?\d+", words[0]) else numbers[0]
    return numbers or text.strip()
