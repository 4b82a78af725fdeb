"""QGIS styles (QML) that travel inside the GeoPackage: one colour per label, and no setting up by hand."""

from __future__ import annotations

from collections.abc import Iterable
from typing import NamedTuple
from xml.sax.saxutils import quoteattr

from loda_pdal.io.colours import CLASS_COLOURS, LABEL_COLOURS, rgb
from loda_pdal.io.qml_review import CATEGORIES, review_elements
from loda_pdal.model.labels import OBJECT_CLASSES, ChangeLabel

LEAST_OPACITY = 45.0
"""Opacity, %, of a change whose confidence is 0; a confidence of 1 is opaque, an unknown one lies between."""

_LEGEND = (
    ChangeLabel.ADDED,
    ChangeLabel.REMOVED,
    ChangeLabel.INCREASED,
    ChangeLabel.DECREASED,
    ChangeLabel.UNDETERMINED,
    ChangeLabel.UNCHANGED,
)


class Category(NamedTuple):
    """One line of a legend: value of the attribute, title, colour ``#rrggbb`` and fill (solid, hatch or none)."""

    value: str
    title: str
    colour: str
    fill: str = "solid"


def change_style() -> str:
    """QML of layer ``changes``: colours by label, opacity by confidence, labels, map tip and the form for reviewing."""
    legend = [label for label in _LEGEND if label is not ChangeLabel.UNCHANGED]
    return _document(_by_label(legend, opacity_by_confidence=True), review_elements(), CATEGORIES)


def label_style() -> str:
    """QML that colours polygons by ``label``: Undetermined is hatched, Unchanged is an outline."""
    return _document(_by_label(_LEGEND))


def _by_label(labels: Iterable[ChangeLabel], opacity_by_confidence: bool = False) -> str:
    fills = {ChangeLabel.UNDETERMINED: "hatch", ChangeLabel.UNCHANGED: "none"}
    legend = [Category(x.title, x.title, LABEL_COLOURS[x], fills.get(x, "solid")) for x in labels]
    return _categorised("label", legend, opacity_by_confidence)


def ground_style() -> str:
    """QML of layer ``ground_changes``: raised and lowered ground."""
    titles = {ChangeLabel.INCREASED: "Raised", ChangeLabel.DECREASED: "Lowered"}
    legend = [Category(label.title, title, LABEL_COLOURS[label]) for label, title in titles.items()]
    return _document(_categorised("label", legend, False))


def class_style() -> str:
    """QML that colours polygons by ``object_class``."""
    categories = [Category(c.title, c.title.capitalize(), CLASS_COLOURS[c]) for c in OBJECT_CLASSES]
    return _document(_categorised("object_class", categories, False))


def outline_style() -> str:
    """QML of polygons drawn as a dashed outline."""
    symbol = _symbol("0", _line_layer("#444444", 0.4, "dash"))
    return _document(f'<renderer-v2 type="singleSymbol"><symbols>{symbol}</symbols></renderer-v2>')


def _categorised(attribute: str, categories: Iterable[Category], opacity_by_confidence: bool) -> str:
    entries, symbols = [], []
    for number, category in enumerate(categories):
        entries.append(
            f'<category symbol="{number}" value={quoteattr(category.value)} type="string" '
            f'label={quoteattr(category.title)} render="true"/>'
        )
        symbols.append(_symbol(str(number), _layers(category), opacity_by_confidence and category.fill == "solid"))
    return (
        f'<renderer-v2 type="categorizedSymbol" attr="{attribute}" symbollevels="0" enableorderby="0">'
        f"<categories>{''.join(entries)}</categories><symbols>{''.join(symbols)}</symbols></renderer-v2>"
    )


def _document(renderer: str, more: str = "", categories: str = "Symbology") -> str:
    return (
        "<!DOCTYPE qgis PUBLIC 'http://mrcc.com/qgis.dtd' 'SYSTEM'>\n"
        f'<qgis version="3.34.0" styleCategories="{categories}">{renderer}{more}'
        "<blendMode>0</blendMode><featureBlendMode>0</featureBlendMode><layerOpacity>1</layerOpacity></qgis>"
    )


def _layers(category: Category) -> str:
    if category.fill == "hatch":
        return _hatch_layer(category.colour) + _line_layer(category.colour, 0.4, "solid")
    if category.fill == "none":
        return _line_layer(category.colour, 0.26, "solid")
    return _fill_layer(category.colour)


def _symbol(name: str, layers: str, opacity_by_confidence: bool = False) -> str:
    opacity = _opacity_property() if opacity_by_confidence else ""
    return (
        f'<symbol name="{name}" type="fill" alpha="1" clip_to_extent="1" force_rhr="0">'
        f"<data_defined_properties>{_properties(opacity)}</data_defined_properties>{layers}</symbol>"
    )


def _properties(entries: str) -> str:
    inside = f'<Option name="properties" type="Map">{entries}</Option>' if entries else '<Option name="properties"/>'
    return (
        '<Option type="Map"><Option name="name" type="QString" value=""/>'
        f'{inside}<Option name="type" type="QString" value="collection"/></Option>'
    )


def _opacity_property() -> str:
    expression = f'{LEAST_OPACITY:g} + {100 - LEAST_OPACITY:g} * coalesce("confidence", 0.5)'
    return (
        '<Option name="alpha" type="Map"><Option name="active" type="bool" value="true"/>'
        f'<Option name="expression" type="QString" value={quoteattr(expression)}/>'
        '<Option name="type" type="int" value="3"/></Option>'
    )


def _fill_layer(colour: str) -> str:
    return _layer(
        "SimpleFill",
        {
            "color": _rgba(colour, 170),
            "style": "solid",
            "outline_color": _rgba(_darker(colour)),
            "outline_style": "solid",
            "outline_width": "0.4",
            "outline_width_unit": "MM",
            "joinstyle": "round",
        },
    )


def _line_layer(colour: str, width_mm: float, dash: str) -> str:
    return _layer(
        "SimpleLine",
        {
            "line_color": _rgba(colour),
            "line_style": dash,
            "line_width": f"{width_mm:g}",
            "line_width_unit": "MM",
            "joinstyle": "round",
        },
    )


def _hatch_layer(colour: str) -> str:
    line = (
        '<symbol name="@hatch" type="line" alpha="1" clip_to_extent="1" force_rhr="0">'
        f"{_line_layer(colour, 0.3, 'solid')}</symbol>"
    )
    return _layer(
        "LinePatternFill", {"angle": "45", "distance": "1.8", "distance_unit": "MM", "line_width": "0.3"}, line
    )


def _layer(kind: str, options: dict[str, str], symbol: str = "") -> str:
    values = "".join(f'<Option name="{key}" type="QString" value="{value}"/>' for key, value in options.items())
    return f'<layer class="{kind}" enabled="1" locked="0" pass="0"><Option type="Map">{values}</Option>{symbol}</layer>'


def _rgba(colour: str, alpha: int = 255) -> str:
    red, green, blue = rgb(colour)
    return f"{red},{green},{blue},{alpha}"


def _darker(colour: str) -> str:
    return "#" + "".join(f"{round(0.6 * value):02x}" for value in rgb(colour))
