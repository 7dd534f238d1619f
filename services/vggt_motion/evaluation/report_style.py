"""The style sheet of the report."""

CSS = """
:root { --ink: #1b1f24; --muted: #57606a; --line: #d8dee4; --soft: #f6f8fa; --blue: #0072b2; }
* { box-sizing: border-box; }
body {
  margin: 0;
  color: var(--ink);
  background: #fff;
  font: 15px/1.5 system-ui, "Segoe UI", Roboto, "DejaVu Sans", sans-serif;
}
header, main, footer { max-width: 1060px; margin: 0 auto; padding: 0 24px; }
header { padding-top: 28px; }
h1 { font-size: 26px; margin: 0 0 2px; }
h2 { font-size: 19px; margin: 40px 0 10px; padding-top: 14px; border-top: 1px solid var(--line); }
h3 { font-size: 15px; margin: 20px 0 6px; }
p { margin: 6px 0 12px; max-width: 76ch; }
nav { margin: 14px 0 18px; display: flex; flex-wrap: wrap; gap: 4px 18px; }
a { color: var(--blue); }
.muted { color: var(--muted); }
.cards {
  display: grid;
  grid-template-columns: repeat(auto-fill, minmax(160px, 1fr));
  gap: 10px;
  margin: 0 0 8px;
  padding: 0;
}
.card { border: 1px solid var(--line); border-radius: 8px; padding: 10px 14px; background: var(--soft); }
.card dt { color: var(--muted); font-size: 13px; margin: 0; }
.card dd { margin: 0; font-size: 21px; font-weight: 650; font-variant-numeric: tabular-nums; }
.card dd.note { font-size: 13px; font-weight: 400; color: var(--muted); }
.card dd small { font-size: 13px; font-weight: 400; color: var(--muted); }
figure { margin: 10px 0 18px; }
figure img { max-width: 100%; height: auto; display: block; }
figcaption { color: var(--muted); font-size: 13.5px; margin-top: 4px; max-width: 92ch; }
.scroll { overflow-x: auto; }
table { border-collapse: collapse; font-size: 13.5px; font-variant-numeric: tabular-nums; min-width: 60%; }
th, td {
  text-align: left;
  padding: 4px 12px 4px 0;
  border-bottom: 1px solid var(--line);
  vertical-align: top;
  overflow-wrap: anywhere;
}
th { color: var(--muted); font-weight: 600; white-space: nowrap; }
td.number, th.number { text-align: right; white-space: nowrap; }
.chip {
  display: inline-block;
  border-radius: 10px;
  padding: 0 9px;
  font-size: 12.5px;
  white-space: nowrap;
  border: 1px solid;
}
.good { color: #05603a; background: #e6f6ef; border-color: #a6dcc4; }
.doubtful { color: #7a4b00; background: #fff4dd; border-color: #efcf8e; }
.bad { color: #8a2a00; background: #fdeae0; border-color: #efb596; }
.notice { border-left: 4px solid #e69f00; background: #fff8ea; padding: 8px 14px; margin: 10px 0; }
.notice.bad { border-color: #d55e00; background: #fdeee6; color: inherit; }
ul.plain { padding-left: 20px; margin: 4px 0 12px; }
pre {
  background: var(--soft);
  border: 1px solid var(--line);
  border-radius: 6px;
  padding: 12px 14px;
  overflow-x: auto;
  font-size: 12.5px;
  line-height: 1.45;
}
summary { cursor: pointer; }
footer { color: var(--muted); font-size: 13px; padding: 26px 24px 40px; }
@media print { nav { display: none; } h2 { break-after: avoid; } figure, .card { break-inside: avoid; } }
"""
