"""What the style of layer ``changes`` holds besides colours: labels, a map tip, and a form for reviewing.

QGIS takes all of it from the GeoPackage, so a result can be reviewed wherever it is opened, plugin or not.
"""

from __future__ import annotations

from collections.abc import Iterable
from xml.sax.saxutils import escape, quoteattr

from loda_pdal.io.reviews import STATUSES

LABELS_FROM_SCALE = 1500
"""Labels are drawn at 1 : this and closer."""

CATEGORIES = "Symbology|Labeling|Fields|Forms|MapTips"

_LABEL = (
    "\"label\" || ' ' || \"object_class\" || coalesce('\\n' || format_number(\"dh_m\", 2) || ' m', '')"
    " || coalesce('\\n' || round(100 * \"confidence\") || ' %', '')"
)

MAP_TIP = """<div style="width:430px">
<b>[% "label" %]: [% "object_class" %] [% "object_id" %]</b>
[% coalesce('&nbsp; confidence ' || round(100 * "confidence") || ' %', '') %]<br>
[% "reason" %]<br>
<small>Review: [% "review_status" || coalesce(', ' || "review_note", '') %]</small>
</div>"""

ALIASES = {
    "object_id": "Object",
    "parent_id": "Part of object",
    "label": "Change",
    "object_class": "Class",
    "confidence": "Confidence",
    "confidence_raw": "Confidence before calibration",
    "observability": "Share the other survey could see",
    "height_before_m": "Height before, m",
    "height_after_m": "Height after, m",
    "dh_m": "Height change, m",
    "volume_before_m3": "Volume before, m³",
    "volume_after_m3": "Volume after, m³",
    "dv_m3": "Volume change, m³",
    "dv_ratio": "Volume change, share",
    "iou_3d": "Overlap (3D IoU)",
    "shift_m": "Centre moved by, m",
    "d_perp_m": "Surface shift, m",
    "lod95_m": "LoD95, m",
    "points_before": "Points before",
    "points_after": "Points after",
    "z_min_m": "Lowest, m",
    "z_max_m": "Highest, m",
    "reason": "Why",
    "review_status": "Status",
    "review_note": "Note",
    "reviewer": "Reviewer",
    "reviewed_at": "Reviewed at",
}
"""How the form names each column, in its order."""

_FINDING = ("object_id", "label", "object_class", "reason", "confidence", "dh_m", "lod95_m")
_REVIEW = ("review_status", "review_note", "reviewer", "reviewed_at")
_EDITABLE = ("review_status", "review_note")
_ON_UPDATE = {
    "reviewer": "if(length(@user_full_name) > 0, @user_full_name, @user_account_name)",
    "reviewed_at": "now()",
}
_DECIMALS = {
    2: ("confidence", "confidence_raw", "observability", "dv_ratio", "iou_3d"),
    3: ("height_before_m", "height_after_m", "dh_m", "shift_m", "d_perp_m", "lod95_m", "z_min_m", "z_max_m"),
    1: ("volume_before_m3", "volume_after_m3", "dv_m3"),
}
_COLUMN_IN_NO_FORM = ("fid", "label_code")


def review_elements() -> str:
    """The elements of a QML document that make labels, map tip and form."""
    figures = [name for name in ALIASES if name not in _FINDING + _REVIEW]
    columns = (*_COLUMN_IN_NO_FORM, *ALIASES)
    return "".join(
        (
            _labelling(),
            f'<mapTip enabled="1">{escape(MAP_TIP)}</mapTip>',
            _each("aliases", "alias", ((name, f"name={quoteattr(alias)}") for name, alias in ALIASES.items())),
            _each(
                "defaults",
                "default",
                ((name, f'expression={quoteattr(text)} applyOnUpdate="1"') for name, text in _ON_UPDATE.items()),
            ),
            "<editable>",
            *(f'<field name="{name}" editable="{int(name in _EDITABLE)}"/>' for name in columns),
            "</editable>",
            _widgets(),
            "<editorlayout>tablayout</editorlayout><attributeEditorForm>",
            _group("Change", _FINDING),
            _group("Review", _REVIEW),
            _group("Figures", figures, is_folded=True),
            "</attributeEditorForm>",
            '<previewExpression>"label" || \' \' || "object_class" || \' \' || "object_id"</previewExpression>',
        )
    )


def _labelling() -> str:
    return (
        f'<labeling type="simple"><settings><text-style fieldName={quoteattr(_LABEL)} isExpression="1" fontSize="8" '
        'fontSizeUnit="Point" fontWeight="75" textColor="20,20,20,255" multilineHeight="1"><text-buffer bufferDraw="1" '
        'bufferSize="0.8" bufferSizeUnits="MM" bufferColor="255,255,255,230"/></text-style>'
        '<placement placement="1" centroidWhole="1" polygonPlacementFlags="2"/>'
        f'<rendering drawLabels="1" scaleVisibility="1" scaleMin="0" scaleMax="{LABELS_FROM_SCALE}" obstacle="1"/>'
        "</settings></labeling>"
    )


def _each(group: str, element: str, entries: Iterable[tuple[str, str]]) -> str:
    return f"<{group}>" + "".join(f'<{element} field="{name}" {rest}/>' for name, rest in entries) + f"</{group}>"


def _widgets() -> str:
    states = "".join(
        f'<Option type="Map"><Option type="QString" name="{status.capitalize()}" value="{status}"/></Option>'
        for status in STATUSES
    )
    many_lines = '<Option type="Map"><Option type="bool" name="IsMultiline" value="true"/></Option>'
    choices = f'<Option type="Map"><Option type="List" name="map">{states}</Option></Option>'
    widgets = {name: ("Range", _number(places)) for places, names in _DECIMALS.items() for name in names} | {
        "reason": ("TextEdit", many_lines),
        "review_status": ("ValueMap", choices),
    }
    return (
        "<fieldConfiguration>"
        + "".join(
            f'<field name="{name}"><editWidget type="{kind}"><config>{config}</config></editWidget></field>'
            for name, (kind, config) in widgets.items()
        )
        + "</fieldConfiguration>"
    )


def _number(decimals: int) -> str:
    """Configuration of a number that is shown with so many decimals."""
    return (
        '<Option type="Map"><Option type="bool" name="AllowNull" value="true"/>'
        '<Option type="double" name="Min" value="-1000000"/><Option type="double" name="Max" value="1000000"/>'
        f'<Option type="int" name="Precision" value="{decimals}"/><Option type="double" name="Step" value="1"/>'
        '<Option type="QString" name="Style" value="SpinBox"/></Option>'
    )


def _group(title: str, names: Iterable[str], is_folded: bool = False) -> str:
    fields = "".join(f'<attributeEditorField name="{name}" index="-1" showLabel="1"/>' for name in names)
    return (
        f'<attributeEditorContainer name="{title}" type="GroupBox" groupBox="1" showLabel="1" columnCount="1" '
        f'collapsed="{int(is_folded)}">'
        f"{fields}</attributeEditorContainer>"
    )
