"""What buttons say about themselves when one points at them: viser shows the hint of any control but a button."""

from __future__ import annotations

import json
from html import escape

import viser

# The second content is read to nobody as a part of the button's name.
STYLE = """
button[data-hint]{overflow:visible}
@media (hover:hover){button[data-hint]:is(:hover,:focus-visible)::after{
  content:attr(data-hint);content:attr(data-hint)/"";position:absolute;z-index:9;left:50%;bottom:calc(100% + 5px);
  transform:translateX(-50%);width:max-content;max-width:20em;padding:5px 10px;border-radius:4px;
  background:var(--mantine-color-gray-9);color:#fff;font-size:13px;font-weight:400;line-height:1.45;text-align:left;
  white-space:normal;pointer-events:none}}
[data-mantine-color-scheme=dark] button[data-hint]::after{background:var(--mantine-color-gray-2)!important;
  color:#000!important}
"""
# Buttons come and go with their tabs, so each gets its hint when it is pointed at or reached.
SCRIPT = (
    "for(const kind of ['pointerover','focusin'])addEventListener(kind,e=>{const b=e.target.closest?.('button[id]'),"
    "told=document.querySelector('[data-hints]');"
    "if(b&&told){const hint=JSON.parse(told.dataset.hints)[b.id];if(hint)b.dataset.hint=hint}})"
)


def tell(gui: viser.GuiApi) -> None:
    """Hand the hints of all buttons that there are to the page."""
    handles = gui._gui_input_handle_from_uuid.items()
    hints = {uuid: button.hint for uuid, button in handles if isinstance(button, viser.GuiButtonHandle) and button.hint}
    gui.add_html(f'<div hidden data-hints="{escape(json.dumps(hints))}"></div>')
