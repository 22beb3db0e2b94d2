//! Tables of text cells.

use std::fmt::Write;

use super::page::escape;

/// A table; the first column names the row.
#[derive(Clone, Debug, Default)]
pub struct Table {
    /// What the numbers are, with their unit.
    pub caption: String,
    /// Column heads.
    pub head: Vec<String>,
    /// Cells, one vector per row: (text, smaller second line, is the best of its column).
    pub rows: Vec<Vec<Cell>>,
}

/// One cell.
#[derive(Clone, Debug, Default)]
pub struct Cell {
    /// Main text.
    pub text: String,
    /// Smaller text after it, for instance an interval.
    pub small: String,
    /// Printed bold.
    pub best: bool,
}

impl<T: Into<String>> From<T> for Cell {
    fn from(text: T) -> Self {
        Self { text: text.into(), ..Self::default() }
    }
}

impl Table {
    /// A table with a caption and column heads.
    pub fn new(caption: &str, head: &[&str]) -> Self {
        Self { caption: caption.into(), head: head.iter().map(|h| (*h).to_string()).collect(), rows: Vec::new() }
    }

    /// Adds a row.
    pub fn row(&mut self, cells: Vec<Cell>) -> &mut Self {
        self.rows.push(cells);
        self
    }

    pub(super) fn to_markdown(&self) -> String {
        let line = |cells: Vec<String>| format!("| {} |\n", cells.join(" | "));
        let mut out = format!("{}\n\n", self.caption);
        out += &line(self.head.clone());
        out += &line(vec!["---".into(); self.head.len()]);
        for row in &self.rows {
            let text = |cell: &Cell| {
                let bold = if cell.best { "**" } else { "" };
                let space = if cell.small.is_empty() { "" } else { " " };
                format!("{bold}{}{bold}{space}{}", cell.text, cell.small).replace('|', "\\|")
            };
            out += &line(row.iter().map(text).collect());
        }
        out + "\n"
    }

    pub(super) fn to_html(&self) -> String {
        let mut html = String::from("<div class=\"scroll\">\n<button data-copy>copy table</button>\n<table>\n");
        let _ = writeln!(html, "<caption>{}</caption>\n<thead><tr>", escape(&self.caption));
        for head in &self.head {
            let _ = write!(html, "<th>{}</th>", escape(head));
        }
        html.push_str("</tr></thead>\n<tbody>\n");
        for row in &self.rows {
            html.push_str("<tr>");
            for cell in row {
                let class = if cell.best { " class=\"best\"" } else { "" };
                let _ = write!(html, "<td{class}>{}", escape(&cell.text));
                if !cell.small.is_empty() {
                    let _ = write!(html, " <small>{}</small>", escape(&cell.small));
                }
                html.push_str("</td>");
            }
            html.push_str("</tr>\n");
        }
        html.push_str("</tbody>\n</table>\n</div>\n");
        html
    }
}
