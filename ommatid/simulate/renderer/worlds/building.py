"""The checked text of a world as a scene of Mitsuba; the same in a trial as in the process that renders."""

# pyright: basic
from __future__ import annotations

from dataclasses import dataclass
from typing import Any

BLOCK = 4  # scalar variants seed by block, and derive its size from the number of threads unless it is given
MOST_SEGMENTS = 10_000  # of a path, before it may end at random: between white walls others never end
BACKWARDS = "ptracer"  # the integrator that starts at the emitters, and takes no block size


@dataclass(frozen=True)
class ParsedWorld:
    """A world as Mitsuba parsed it, without its sensors.

    sensors : properties of the sensors that it had;  has_integrator : True if it has one
    """

    config: Any
    state: Any
    sensors: list[Any]
    has_integrator: bool

    def build(self) -> Any:
        """Return Mitsuba's scene. Raises RuntimeError or TypeError where Mitsuba refuses it."""
        import mitsuba as mi

        return mi.parser.instantiate(self.config, self.state)


def parse_world(text: str, variant: str) -> ParsedWorld:
    """Parse the checked text of a world. Raises RuntimeError or TypeError where Mitsuba refuses it."""
    import mitsuba as mi

    config = mi.parser.ParserConfig(variant)
    state: Any = mi.parser.parse_string(config, text)
    root, resolved = state.root.props, mi.Properties.Type.ResolvedReference
    sensors, has_integrator = list[Any](), False
    for key in list(root.keys()):
        if root.type(key) == resolved:
            node = state.nodes[root[key].index()]
            has_integrator |= node.type == mi.ObjectType.Integrator
            if node.type == mi.ObjectType.Sensor:
                sensors.append(node.props)
                del root[key]
    for node in state.nodes:
        if node.type == mi.ObjectType.Integrator and node.props.plugin_name() != BACKWARDS:
            node.props["block_size"] = BLOCK
    mi.parser.transform_all(config, state)
    for node in state.nodes:
        if node.type == mi.ObjectType.Integrator:
            _check_lengths(node.props)
    return ParsedWorld(config, state, sensors, has_integrator)


def _check_lengths(integrator: Any) -> None:
    """Raise RuntimeError for an integrator whose paths may be endless: a max_depth below 0 is none."""
    most, sure = integrator.get("max_depth", -1), integrator.get("rr_depth", 5)
    if isinstance(most, int) and isinstance(sure, int) and min(sure, most if most >= 0 else sure) > MOST_SEGMENTS:
        raise RuntimeError(
            f"expected paths of at most {MOST_SEGMENTS} segments, got rr_depth {sure} and max_depth {most}; lower one"
        )
