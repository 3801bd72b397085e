"""YAML as plain data: a small part of the language, in which a file of any content costs little."""

import copy
import re
from functools import lru_cache
from typing import Any

import yaml

_MAX_DEPTH = 20
_MAX_DIGITS = 40
_YAML = "tag:yaml.org,2002:"
_STR, _INT, _FLOAT, _BOOL, _NULL = (_YAML + name for name in ("str", "int", "float", "bool", "null"))
# Values of this key at the top are texts: a heat 0123 or a version 1.10 is no number.
_TEXTS = "attributes"


class PlainLoader(yaml.SafeLoader):
    """Texts, numbers, true and false, null, lists and mappings.

    Aliases, tags and deep nesting are errors, and so is a key that stands twice. Days, times, and numbers with leading
    zeros are texts; so are all keys.
    """

    depth = 0

    def compose_node(self, parent: yaml.Node | None, index: Any) -> yaml.Node | None:
        """Refuse what plain data have no need of, before anything is built from it."""
        event: Any = self.peek_event()
        if isinstance(event, yaml.AliasEvent):
            raise _fault("an alias", event)
        if getattr(event, "tag", None) not in (None, "!", _STR):
            known = event.tag.startswith(_YAML)
            raise _fault(f"a tag, {event.tag[len(_YAML) : 60]}" if known else "a tag", event)
        if self.depth == _MAX_DEPTH:
            raise _fault(f"more than {_MAX_DEPTH} levels", event)
        self.depth += 1
        node = super().compose_node(parent, index)
        self.depth -= 1
        return node

    def get_single_node(self) -> yaml.Node | None:
        """The document, with the values of ``attributes`` as they are written."""
        root = super().get_single_node()
        for key, value in root.value if isinstance(root, yaml.MappingNode) else []:
            if key.value == _TEXTS and isinstance(value, yaml.MappingNode):
                for _, item in value.value:
                    if item.tag in (_INT, _FLOAT) and item.value[-1].lower() not in "nf":  # nan and inf stay numbers
                        item.tag = _STR
        return root

    def construct_mapping(self, node: yaml.MappingNode, deep: bool = False) -> dict[Any, Any]:
        """A mapping whose keys are texts, each there once."""
        seen = set()
        for key, _ in node.value:
            if not isinstance(key, yaml.ScalarNode):
                raise _fault("a key that is no text", key)
            if key.value in seen:
                raise _fault(f"the key {key.value[:40]!r} a second time", key)
            seen.add(key.value)
            key.tag = _STR
        mapping: dict[Any, Any] = yaml.constructor.BaseConstructor.construct_mapping(self, node, deep)
        return mapping

    def construct_number(self, node: yaml.ScalarNode) -> int | float:
        """A decimal number."""
        if len(node.value) > _MAX_DIGITS:
            raise _fault(f"a number of {len(node.value)} digits", node)
        if node.tag == _INT:
            return int(node.value)
        return float(re.sub(r"\.(inf|nan)$", r"\1", node.value.lower()))


PlainLoader.yaml_implicit_resolvers = {}  # YAML 1.1's, which make 12:30:45 and 0123 numbers, are not used
PlainLoader.add_constructor(_INT, PlainLoader.construct_number)
PlainLoader.add_constructor(_FLOAT, PlainLoader.construct_number)
PlainLoader.add_implicit_resolver(
    _BOOL,
    re.compile(r"^(?:true|True|TRUE|false|False|FALSE|yes|Yes|YES|no|No|NO|on|On|ON|off|Off|OFF)$"),
    list("tTfFyYnNoO"),
)
PlainLoader.add_implicit_resolver(_NULL, re.compile(r"^(?:~|null|Null|NULL|)$"), ["~", "n", "N", ""])
PlainLoader.add_implicit_resolver(_INT, re.compile(r"^[-+]?(?:0|[1-9][0-9]*)$"), list("-+0123456789"))
PlainLoader.add_implicit_resolver(
    _FLOAT,
    re.compile(
        r"^(?:[-+]?(?:(?:0|[1-9][0-9]*)(?:\.[0-9]*)?(?:[eE][-+]?[0-9]+)?|\.[0-9]+(?:[eE][-+]?[0-9]+)?)"
        r"|[-+]?\.(?:inf|Inf|INF)|\.(?:nan|NaN|NAN))$"
    ),
    list("-+.0123456789"),
)


def load_plain_yaml(text: str) -> object:
    """The plain data of a YAML text; nothing in it is ever executed.

    Raises:
        ValueError: not YAML, or more than plain data; says where and what, and repeats no more of the text than a key.
    """
    return copy.deepcopy(_parsed(text))


@lru_cache(maxsize=16)
def _parsed(text: str) -> object:
    """Parsed once: every strip of an archive looks whether its scan is still what it was."""
    try:
        loader = PlainLoader(text)
        data: object = loader.get_single_data()
    except yaml.reader.ReaderError as error:
        raise ValueError(f"a character that is no text at position {error.position}") from None
    except yaml.MarkedYAMLError as error:
        line = f"line {error.problem_mark.line + 1}: " if error.problem_mark else ""
        raise ValueError(line + re.sub(r"(?<=undefined alias ).*", "", error.problem or str(error.context))) from None
    return data


def _fault(what: str, where: Any) -> yaml.MarkedYAMLError:
    return yaml.MarkedYAMLError(problem=f"found {what}", problem_mark=where.start_mark)
