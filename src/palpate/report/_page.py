"""The HTML page all reports share: one file, no script, nothing fetched; light, dark, print, phone."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence

from ._style import DARK, LIGHT
from ._text import escape, number


def _variables(colours: Mapping[str, str]) -> str:
    return "".join(f"--{name}:{colour};" for name, colour in colours.items())


_CSS = f"""
:root{{color-scheme:light dark;{_variables(LIGHT)}--card:#f6f8fa}}
@media screen and (prefers-color-scheme:dark){{:root{{{_variables(DARK)}--card:#1f262e}}}}
*{{box-sizing:border-box}}
html{{-webkit-text-size-adjust:100%}}
body{{margin:0 auto;max-width:1140px;padding:28px 24px 48px;background:var(--paper);color:var(--ink);
font:16px/1.5 system-ui,-apple-system,"Segoe UI",Roboto,"Helvetica Neue",Arial,sans-serif;overflow-wrap:anywhere}}
h1{{font-size:1.65rem;line-height:1.2;margin:0;font-weight:650}}
h2{{font-size:1.15rem;margin:2.2rem 0 .4rem;font-weight:650;break-after:avoid}}
p{{margin:.3rem 0 .6rem;max-width:100ch}}
.sub{{color:var(--muted);margin:.2rem 0 1.2rem}}
.read{{color:var(--muted);font-size:.92rem}}
.card{{display:flex;gap:24px;background:var(--card);border:1px solid var(--grid);border-radius:14px;
padding:22px 26px;break-inside:avoid}}
.card .words{{flex:1 1 0;min-width:0}}
.card img{{width:32%;max-width:340px;height:auto;aspect-ratio:4/3;object-fit:cover;border-radius:10px;
align-self:center}}
.number{{font-size:3.3rem;line-height:1.1;font-weight:700;color:var(--blue);font-variant-numeric:tabular-nums}}
.number small{{font-size:.5em;font-weight:600;white-space:nowrap}}
.nowrap{{white-space:nowrap}}
.pill{{display:inline-block;border-radius:99px;padding:.05em .8em;font-weight:650;margin-right:.5em;
border:1.5px solid var(--tone);background:color-mix(in srgb,var(--tone) 22%,transparent)}}
.facts{{display:grid;grid-template-columns:repeat(auto-fit,minmax(128px,1fr));gap:12px 20px;margin:16px 0 0}}
.facts dt{{color:var(--muted);font-size:.83rem}}
.facts dd{{margin:0;font-size:1.15rem;font-weight:600;font-variant-numeric:tabular-nums}}
.facts dd small{{display:block;font-size:.83rem;font-weight:400;color:var(--muted)}}
figure{{margin:.6rem 0 0;break-inside:avoid}}
.panels{{display:grid;grid-template-columns:repeat(auto-fill,minmax(min(300px,100%),1fr));gap:8px 14px}}
.pair{{display:grid;grid-template-columns:repeat(auto-fill,minmax(min(420px,100%),1fr));gap:8px 18px}}
.panels figure,.pair figure{{margin:0}}
.pair img{{display:block;width:100%;height:auto;border-radius:8px}}
svg.fig{{display:block;width:100%;height:auto;fill:var(--ink);stroke-linejoin:round;stroke-linecap:butt}}
.key{{display:flex;flex-wrap:wrap;gap:2px 20px;font-size:.9rem;margin:.4rem 0 .5rem;padding:0;list-style:none}}
.key i{{display:inline-block;width:26px;height:0;vertical-align:middle;margin-right:7px;
border-top:2.5px solid var(--tone)}}
.key i.dash{{border-top-style:dashed;border-top-width:1.5px}}
.key i.dots{{border-top-style:dotted;border-top-width:2px}}
.key i.area{{border:0;height:11px;background:var(--tone);opacity:.3}}
.narrow,.key.narrow{{display:none}}
.scroll{{overflow-x:auto}}
table{{border-collapse:collapse;font-size:.93rem;font-variant-numeric:tabular-nums;margin:.4rem 0}}
th,td{{text-align:left;padding:.32em 1.4em .32em 0;overflow-wrap:break-word;
border-bottom:1px solid var(--grid);vertical-align:top}}
th{{font-weight:600}}thead th{{color:var(--muted);font-weight:500;font-size:.85rem}}
tbody th{{min-width:9em}}td.n,th.n{{text-align:right}}td.n{{white-space:nowrap}}
.yes,.no{{font-weight:650;white-space:nowrap}}.yes{{color:var(--green)}}.no{{color:var(--red)}}
ul.plain{{margin:.3rem 0;padding-left:1.2em;font-size:.93rem}}
footer{{margin-top:2.4rem;color:var(--muted);font-size:.85rem;border-top:1px solid var(--grid);padding-top:.7rem}}
@media screen and (max-width:680px){{
body{{padding:18px 14px 36px}}
.card{{flex-direction:column;padding:16px 16px 18px;gap:14px}}
.card img{{width:100%;max-width:none}}
.number{{font-size:2.5rem}}
table{{font-size:.84rem}}th,td{{padding-right:.7em}}tbody th{{min-width:7em}}
.wide{{display:none}}.narrow{{display:block}}.key.narrow{{display:flex}}
}}
@media print{{
@page{{size:A4;margin:13mm}}
body{{padding:0;max-width:none;font-size:9.5pt}}
.number{{font-size:2.6rem}}.card{{padding:14px 18px}}.facts{{grid-template-columns:repeat(4,auto)}}
h2{{margin-top:1.3rem}}
.panels{{grid-template-columns:repeat(3,1fr);gap:2px 8px}}
svg.fig{{min-width:0!important}}
.card,.pill{{print-color-adjust:exact;-webkit-print-color-adjust:exact}}
}}
"""


def page(title: str, sections: Iterable[str]) -> str:
    """A whole document. `title` is escaped here; sections are HTML already."""
    return "\n".join(
        (
            "<!DOCTYPE html>",
            '<html lang="en"><head><meta charset="utf-8">',
            # nothing may be fetched or run, whatever text got into the page
            '<meta http-equiv="Content-Security-Policy" content="default-src \'none\'; '
            "style-src 'unsafe-inline'; img-src data:\">",
            '<meta name="generator" content="palpate">',  # by which its own pages are known, to be replaced
            '<meta name="viewport" content="width=device-width, initial-scale=1">',
            f"<title>{escape(title)}</title>",
            f"<style>{_CSS}</style></head><body>",
            *sections,
            "</body></html>",
            "",
        )
    )


def section(heading: str, *parts: str) -> str:
    """A heading, escaped, and HTML below it."""
    return "\n".join((f"<section><h2>{escape(heading)}</h2>", *(p for p in parts if p), "</section>"))


def read(text: str) -> str:
    """How to read what stands above; written here, so plain text."""
    return f'<p class="read">{escape(text, 1000)}</p>'


def key(entries: Sequence[tuple[str, str, str]], *, narrow: bool = False) -> str:
    """Names of curves: (name, colour of the palette, "line", "dash", "dots" or "area") each."""
    items = "".join(
        f'<li><i class="{kind}" style="--tone:var(--{colour})"></i>{escape(name, 160)}</li>'
        for name, colour, kind in entries
    )
    return f'<ul class="key{" narrow" * narrow}">{items}</ul>'


def table(head: Sequence[str], rows: Iterable[Sequence[str]], numeric: frozenset[int] = frozenset()) -> str:
    """A table of HTML cells; the first cell of each row is its heading. `numeric` columns are set right."""

    def cell(tag: str, column: int, text: str) -> str:
        right = ' class="n"' if column in numeric else ""
        return f"<{tag}{right}>{text}</{tag}>"

    top = "".join(cell("th", i, escape(h)) for i, h in enumerate(head))
    body = "".join(
        "<tr>" + "".join(cell("th" if i == 0 else "td", i, c) for i, c in enumerate(row)) + "</tr>"
        for row in rows
    )
    return (
        '<div class="scroll"><table>'
        + (f"<thead><tr>{top}</tr></thead>" if head else "")
        + f"<tbody>{body}</tbody></table></div>"
    )


def mapping_table(values: Mapping[str, object]) -> str:
    """Names and values, escaped."""
    return table((), ((escape(k), escape(number(v, 6))) for k, v in values.items()))


def lines(texts: Sequence[str]) -> str:
    """A list of escaped lines."""
    return '<ul class="plain">' + "".join(f"<li>{escape(t)}</li>" for t in texts) + "</ul>"
