//! The page: title, sections, footer, style.

use std::fmt::Write;

use super::line_plot::LinePlot;
use super::table::Table;
use crate::output::Provenance;

/// A value of the footer with more bytes than this is folded.
const LONG: usize = 1000;

/// Replaces the characters that HTML gives a meaning to.
pub fn escape(text: &str) -> String {
    text.replace('&', "&amp;").replace('<', "&lt;").replace('>', "&gt;").replace('"', "&quot;")
}

/// A report under construction.
#[derive(Clone, Debug)]
pub struct Page {
    title: String,
    body: String,
    footer: Vec<(String, String)>,
}

impl Page {
    /// A page with a title and one paragraph that says what was done and what came out.
    pub fn new(title: &str, lead: &str) -> Self {
        let body = format!("<p class=\"lead\">{}</p>\n", escape(lead));
        Self { title: title.into(), body, footer: Vec::new() }
    }

    /// Starts a section.
    pub fn section(&mut self, heading: &str) -> &mut Self {
        let _ = writeln!(self.body, "<h2>{}</h2>", escape(heading));
        self
    }

    /// Adds a paragraph of plain text.
    pub fn text(&mut self, text: &str) -> &mut Self {
        let _ = writeln!(self.body, "<p>{}</p>", escape(text));
        self
    }

    /// Adds a table with a button that copies it as tab-separated text.
    pub fn table(&mut self, table: &Table) -> &mut Self {
        self.body.push_str(&table.to_html());
        self
    }

    /// Adds plots side by side, as many per row as fit, under one legend and one caption.
    pub fn plots(&mut self, plots: &[LinePlot], caption: &str) -> &mut Self {
        self.body.push_str("<figure>\n");
        if let Some(first) = plots.iter().max_by_key(|p| p.series.len()) {
            self.body.push_str(&first.legend_html());
        }
        self.body.push_str("<div class=\"plots\">\n");
        for plot in plots {
            self.body.push_str(&plot.to_svg());
        }
        let _ = writeln!(self.body, "</div>\n<figcaption>{}</figcaption>\n</figure>", escape(caption));
        self
    }

    /// Adds a line to the footer: what the page was made from.
    pub fn footer(&mut self, name: &str, value: &str) -> &mut Self {
        self.footer.push((name.into(), value.into()));
        self
    }

    /// Adds what made the page and what it was made from to the footer.
    pub fn made_from(&mut self, provenance: &Provenance) -> &mut Self {
        let Provenance { version, command, bundle, bundle_hash, data_hash, maps_hash } = provenance;
        self.footer("command", command)
            .footer("version", &format!("nesam {version}"))
            .footer("bundle", &format!("{bundle} {bundle_hash}"))
            .footer("data", data_hash)
            .footer("maps", maps_hash)
    }

    /// The finished HTML document.
    pub fn render(&self) -> String {
        let title = escape(&self.title);
        let mut footer = String::new();
        for (name, value) in &self.footer {
            let code = format!("<code>{}</code>", escape(value));
            let folded = || format!("<details><summary><code>{} …</code></summary>{code}</details>", escape(beginning(value)));
            let shown = if value.len() > LONG { folded() } else { code.clone() };
            let _ = writeln!(footer, "<dt>{}</dt><dd>{shown}</dd>", escape(name));
        }
        format!(
            "<!doctype html>\n<html lang=\"en\">\n<head>\n<meta charset=\"utf-8\">\n\
             <meta name=\"viewport\" content=\"width=device-width, initial-scale=1\">\n<title>{title}</title>\n\
             <style>{STYLE}</style>\n</head>\n<body>\n<main>\n<h1>{title}</h1>\n{}\n<footer><dl>\n{footer}</dl></footer>\n\
             </main>\n<script>{SCRIPT}</script>\n</body>\n</html>\n",
            self.body
        )
    }
}

/// The first words of a folded value, at most 60 characters.
fn beginning(value: &str) -> &str {
    let end = value.char_indices().nth(60).map_or(value.len(), |(i, _)| i);
    value[..end].rsplit_once([' ', ',']).map_or(&value[..end], |(words, _)| words)
}

const STYLE: &str = r#"
:root { color-scheme: light dark; --ink: #1b1f24; --paper: #ffffff; --soft: #5b6570; --line: #d8dde3; --row: #f5f7f9;
  --c0: #1b1f24; --c1: #0072b2; --c2: #d55e00; --c3: #009e73; --c4: #cc79a7; --c5: #b07c00; --c6: #3a9bd0; }
@media (prefers-color-scheme: dark) { :root { --ink: #e6e9ec; --paper: #14171a; --soft: #9aa4ae; --line: #343b43; --row: #1c2126;
  --c0: #e6e9ec; --c1: #56a8e0; --c2: #f08a3c; --c3: #2fc79a; --c4: #e3a0c8; --c5: #f0c040; --c6: #8ad0f5; } }
* { box-sizing: border-box; }
body { margin: 0; background: var(--paper); color: var(--ink); font: 15px/1.55 system-ui, sans-serif; }
main { max-width: 1180px; margin: 0 auto; padding: 2rem 1.25rem 4rem; }
h1 { font-size: 1.7rem; line-height: 1.2; margin: 0 0 .6rem; }
h2 { font-size: 1.2rem; margin: 2.4rem 0 .6rem; }
p { max-width: 75ch; } .lead { font-size: 1.08rem; color: var(--soft); }
.scroll { overflow-x: auto; } .scroll + .scroll { margin-top: 1.4rem; }
table { border-collapse: collapse; font-variant-numeric: tabular-nums; font-size: .9rem; }
caption { text-align: left; color: var(--soft); padding: .3rem 0; }
th, td { padding: .3rem .7rem; text-align: right; border-bottom: 1px solid var(--line); white-space: nowrap; }
th:first-child, td:first-child, .words { text-align: left; }
tbody tr:nth-child(odd) { background: var(--row); } td.best { font-weight: 700; } td small { color: var(--soft); display: block; }
button { font: inherit; font-size: .8rem; color: var(--soft); background: none; border: 1px solid var(--line);
  border-radius: 4px; padding: .1rem .5rem; cursor: pointer; margin: .4rem 0; }
button:hover { color: var(--ink); }
figure { margin: 1rem 0; } figcaption { color: var(--soft); font-size: .88rem; max-width: 95ch; }
.plots { display: grid; grid-template-columns: repeat(auto-fill, minmax(330px, 1fr)); gap: .8rem; }
.legend { display: flex; flex-wrap: wrap; gap: .2rem 1.2rem; font-size: .88rem; margin: .3rem 0; }
.legend svg { width: 34px; height: 10px; vertical-align: middle; margin-right: .35rem; }
svg.plot { width: 100%; height: auto; display: block; }
svg.plot text { fill: var(--soft); font: 11px system-ui, sans-serif; } svg.plot text.title { fill: var(--ink); font-weight: 600; }
svg .grid { stroke: var(--line); stroke-width: 1; } svg .frame { stroke: var(--soft); fill: none; }
svg .hit { fill: transparent; stroke: none; } svg .hit:hover { fill: var(--ink); fill-opacity: .35; }
.s0 { stroke: var(--c0); fill: var(--c0); } .s1 { stroke: var(--c1); fill: var(--c1); } .s2 { stroke: var(--c2); fill: var(--c2); }
.s3 { stroke: var(--c3); fill: var(--c3); } .s4 { stroke: var(--c4); fill: var(--c4); } .s5 { stroke: var(--c5); fill: var(--c5); }
.s6 { stroke: var(--c6); fill: var(--c6); }
path.line { fill: none; stroke-width: 2; stroke-linejoin: round; } path.band { stroke: none; fill-opacity: .16; }
svg .probe { stroke: var(--ink); stroke-opacity: .6; fill: none; pointer-events: none; }
#note { position: fixed; z-index: 2; background: var(--paper); border: 1px solid var(--line); border-radius: 4px; padding: .25rem .6rem;
  font-size: .8rem; font-variant-numeric: tabular-nums; pointer-events: none; box-shadow: 0 1px 6px #0003; }
footer { margin-top: 3rem; border-top: 1px solid var(--line); color: var(--soft); font-size: .85rem; }
dl { display: grid; grid-template-columns: max-content 1fr; gap: .15rem 1rem; } dd { margin: 0; overflow-wrap: anywhere; } summary { cursor: pointer; }
@media (max-width: 900px) { table { font-size: .82rem; } th, td { padding: .25rem .35rem; } }
@media print { button, #note { display: none; } }
"#;

const SCRIPT: &str = r#"
document.querySelectorAll('button[data-copy]').forEach(b => b.addEventListener('click', async () => {
  const rows = [...b.nextElementSibling.querySelectorAll('tr')];
  const text = rows.map(r => [...r.cells].map(c => c.innerText.trim().replace(/\s+/g, ' ')).join('\t')).join('\n');
  const say = t => { b.textContent = t; setTimeout(() => b.textContent = 'copy table', 1500); };
  try { await navigator.clipboard.writeText(text); say('copied'); } catch {
    // A browser that gives no clipboard to files: the table is selected instead.
    getSelection().selectAllChildren(b.nextElementSibling); say('selected, press ctrl-c');
  }
}));
const note = document.createElement('div');
note.id = 'note'; note.hidden = true; document.body.append(note);
document.querySelectorAll('svg.plot').forEach(svg => {
  const dots = [...svg.querySelectorAll('circle.hit')].map(c => {
    const title = c.querySelector('title'), dot = { x: +c.getAttribute('cx'), y: +c.getAttribute('cy'), text: title.textContent };
    title.remove();
    return dot;
  });
  const probe = document.createElementNS(svg.namespaceURI, 'path');
  probe.setAttribute('class', 'probe'); svg.append(probe);
  const leave = () => { note.hidden = true; probe.setAttribute('d', ''); };
  svg.addEventListener('pointerleave', leave);
  svg.addEventListener('pointermove', e => {
    if (!dots.length) return;
    const p = new DOMPoint(e.clientX, e.clientY).matrixTransform(svg.getScreenCTM().inverse());
    const far = svg.dataset.near === 'point' ? d => Math.hypot(d.x - p.x, d.y - p.y) : d => Math.abs(d.x - p.x);
    const near = dots.reduce((a, b) => far(b) < far(a) ? b : a);
    // Along a curve all lines are read at once; on a path the point that is nearest.
    const read = svg.dataset.near === 'point' ? [near] : dots.filter(d => Math.abs(d.x - near.x) < .6).sort((a, b) => a.y - b.y);
    const [, top,, bottom] = svg.dataset.frame.split(' ').map(Number);
    probe.setAttribute('d', svg.dataset.near === 'point' ? `M${near.x - 5} ${near.y}h10m-5-5v10` : `M${near.x} ${top}V${bottom}`);
    note.replaceChildren(...read.map(d => Object.assign(document.createElement('div'), { textContent: d.text })));
    note.hidden = false;
    note.style.left = `${Math.min(e.clientX + 14, innerWidth - note.offsetWidth - 8)}px`;
    note.style.top = `${Math.min(e.clientY + 14, innerHeight - note.offsetHeight - 8)}px`;
  });
});
"#;

#[cfg(test)]
mod tests {
    use super::*;
    use crate::report::Series;

    #[test]
    fn property_page_is_self_contained_and_escapes_text() {
        let mut page = Page::new("a < b", "lead & more");
        let mut plot = LinePlot::new("error", "t [s]", "m");
        plot.series.push(Series::line("<model>", 1, vec![(0.0, 0.0), (1.0, 2.0)]));
        page.section("one").plots(&[plot], "caption").footer("command", "nesam evaluate --set \"x\"").footer("filter", &"1,".repeat(LONG));
        let html = page.render();
        assert!(html.contains("a &lt; b") && html.contains("&lt;model&gt;") && html.contains("--set &quot;x&quot;"));
        assert_eq!(html.matches("<details>").count(), 1, "what is long is folded, what is short is not");
        assert!(html.contains("<summary><code>1,1,1,"), "a folded value shows how it begins");
        for outside in ["http://", "https://", "src=", "@import", "url("] {
            assert!(!html.contains(outside), "the page must not load `{outside}`");
        }
        assert_eq!(html.matches("<svg").count(), html.matches("</svg>").count());
    }
}
