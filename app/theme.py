"""Colours, style sheet and small HTML pieces of the dashboard: one place decides how everything looks."""

from __future__ import annotations

from html import escape

RGB = tuple[int, int, int]

# Orange against blue stays apart for colour-blind readers; magenta and green mark what is rare.
ESTIMATE: RGB = (249, 115, 22)
TRUTH: RGB = (59, 130, 246)
KEYFRAME: RGB = (120, 134, 156)
WINDOW: RGB = (217, 70, 239)
LOOP: RGB = (16, 185, 129)
BEFORE: RGB = (239, 68, 68)
OTHER: RGB = (20, 184, 166)
MEASURE: RGB = (124, 58, 237)
ACCENT: RGB = (234, 88, 12)
NONE = "–"
GRID: tuple[RGB, RGB] = (198, 206, 216), (58, 64, 74)  # light, dark

STATE_COLORS: dict[str, RGB] = {
    "idle": KEYFRAME,
    "initialising": TRUTH,
    "tracking": LOOP,
    "mapping": LOOP,
    "lost": BEFORE,
    "relocalising": ESTIMATE,
    "paused": (234, 179, 8),
    "finished": TRUTH,
    "failed": BEFORE,
}


def css(color: RGB) -> str:
    """An RGB triple as a CSS colour."""
    return f"rgb({color[0]},{color[1]},{color[2]})"


STYLE = """
[style*="letter-spacing"]{letter-spacing:normal!important}
.mantine-Tabs-tab{padding:9px 10px;font-size:13px}
.mantine-ScrollArea-scrollbar[data-orientation=vertical]{width:7px!important;padding:1px}
[data-mantine-color-scheme=light] div[style*="background-color: rgb(255, 255, 255); overflow: hidden"]{
  background:linear-gradient(#fdfdfe,#e8ecf1)!important}
[data-mantine-color-scheme=dark] div[style*="background-color: rgb(20, 20, 20); overflow: hidden"]{
  background:linear-gradient(#1a1d22,#0e1013)!important}
.mantine-Button-root{border-radius:7px;font-weight:600}
.mantine-Button-root[style*="gray-filled"]{--button-bg:transparent!important;--button-hover:rgba(128,128,128,.12)!important;
  --button-color:var(--mantine-color-text)!important;border:1px solid var(--mantine-color-default-border)}
@media (max-width:48em){.mantine-Paper-root[style*="bottom: 0px"]{width:100%!important;max-height:52%!important;
  border-radius:14px 14px 0 0!important}.mantine-Paper-root [style*="width: 20em"]{width:100%!important}}
.u-legend{font-size:11.5px!important;text-align:left!important}
.ec-upright{display:none!important}
.u-title{font-size:12.5px!important;font-weight:600}
.ec{--dim:color-mix(in srgb,var(--mantine-color-text) 64%,transparent);font-size:12.5px;line-height:1.45;
  color:var(--mantine-color-text);padding:4px 8px 6px;
  font-variant-numeric:tabular-nums}
.ec b{font-weight:600}
.ec .dim{color:var(--dim);overflow-wrap:anywhere}
.ec-head{display:flex;align-items:center;gap:8px;margin-bottom:7px;min-width:0}
.ec-chip{display:inline-flex;align-items:center;gap:6px;padding:2px 10px 2px 8px;border-radius:999px;font-weight:600;
  font-size:12px;white-space:nowrap;color:color-mix(in srgb,var(--c) 55%,var(--mantine-color-text));
  background:color-mix(in srgb,var(--c) 14%,transparent)}
.ec-chip i{width:7px;height:7px;border-radius:50%;background:var(--c)}
.ec-name{flex:1;min-width:0;text-align:right;overflow:hidden;text-overflow:ellipsis;white-space:nowrap}
.ec-bar{height:5px;border-radius:3px;background:var(--mantine-color-default-border);overflow:hidden;margin:3px 0 9px}
.ec-bar i{display:block;height:100%;border-radius:3px;background:rgb(234,88,12)}
.ec-row{display:flex;justify-content:space-between;gap:8px}
.ec-grid{display:grid;margin-bottom:4px;grid-template-columns:repeat(3,minmax(0,1fr));gap:6px}
.ec-cell{border:1px solid var(--mantine-color-default-border);border-radius:8px;padding:5px 8px 4px;min-width:0}
.ec-cell b{display:block;font-size:15px;line-height:1.3;white-space:nowrap;letter-spacing:-.01em}
.ec-cell span{font-size:10.5px;color:var(--dim);white-space:nowrap}
.ec-cell small{font-size:10.5px;font-weight:500;color:var(--dim);margin-left:2px}
.ec-note{margin:7px 0;padding:6px 9px;border-radius:8px;border-left:3px solid var(--c);overflow-wrap:anywhere;
  background:color-mix(in srgb,var(--c) 10%,transparent)}
.ec table{width:100%;border-collapse:collapse}
.ec td,.ec th{padding:3px 4px;text-align:right;font-weight:400;
  border-bottom:1px solid var(--mantine-color-default-border)}
.ec td:first-child,.ec th:first-child{text-align:left;color:var(--dim)}
.ec th{font-weight:600}
.ec-key{display:flex;flex-wrap:wrap;gap:3px 10px;font-size:11.5px;color:var(--dim)}
.ec-key i{display:inline-block;width:14px;height:3px;border-radius:2px;margin-right:5px;background:var(--c);
  vertical-align:middle}
.ec-six{display:grid;grid-template-columns:1fr 1fr;gap:5px}
.ec-six figure{margin:0;position:relative;border-radius:6px;overflow:hidden;background:#8884}
.ec-six figure:only-child{grid-column:1/-1}
.ec-six img{width:100%;display:block}
.ec-six figcaption{position:absolute;left:5px;bottom:4px;font-size:10px;padding:0 6px;border-radius:9px;color:#fff;
  background:#0009}
[data-away]::after{content:attr(data-away);position:fixed;z-index:999;left:16px;top:16px;max-width:min(30em,80vw);
  padding:10px 14px;border-radius:8px;background:rgb(153,27,27);color:#fff;font-size:14px;line-height:1.45;
  font-family:system-ui,sans-serif}
@media (max-width:48em){.ec-grid{gap:4px}.ec-cell{padding:2px 7px 1px}.ec-cell b{font-size:13.5px;line-height:1.2}}
"""


def chip(text: str, color: RGB) -> str:
    """A pill with a coloured dot."""
    return f'<span class="ec-chip" style="--c:{css(color)}"><i></i>{escape(text)}</span>'


def cell(value: str, unit: str, label: str) -> str:
    """One figure with its unit and name; where there is none, a dash has no unit."""
    unit = "" if value == NONE else unit
    return f'<div class="ec-cell"><b>{escape(value)}<small>{escape(unit)}</small></b><span>{escape(label)}</span></div>'


def note(text: str, color: RGB) -> str:
    """A paragraph with a coloured edge."""
    return f'<div class="ec-note" style="--c:{css(color)}">{escape(text)}</div>'


def card(html: str) -> str:
    """Wrap pieces for a panel of their own."""
    return f'<div class="ec">{html}</div>'


def legend(entries: list[tuple[str, RGB]]) -> str:
    """What colours mean."""
    items = "".join(f'<span><i style="--c:{css(color)}"></i>{escape(name)}</span>' for name, color in entries)
    return f'<div class="ec-key">{items}</div>'


def number(value: float | None, digits: int = 2) -> str:
    """A figure for people; a dash where there is none."""
    return NONE if value is None or value != value else f"{value:.{digits}f}"


def size(count: int) -> str:
    """So many bytes for people: 820 bytes, 45 kB, 12.3 MB."""
    if count < 1000:
        return f"{count} bytes"
    return f"{count / 1e3:.0f} kB" if count < 999_500 else f"{count / 1e6:.1f} MB"
