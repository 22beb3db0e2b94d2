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

impl Cell {
    /// A number with its interval; a dash where there is none.
    pub fn with_interval(value: Option<f64>, interval: Option<[f64; 2]>) -> Self {
        let small = interval.map_or(String::new(), |[lo, hi]| format!("[{lo:.3}, {hi:.3}]"));
        Self { text: value.map_or("–".into(), |v| format!("{v:.3}")), small, best: false }
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

    /// Whether a column holds words, which begin on the left, and not numbers.
    fn has_words(&self, column: usize) -> bool {
        let mut told = self.rows.iter().filter_map(|row| row.get(column)).filter(|cell| !cell.text.is_empty()).peekable();
        told.peek().is_some() && told.all(|cell| cell.text.starts_with(char::is_alphabetic))
    }

    pub(super) fn to_html(&self) -> String {
        let mut html = String::from("<div class=\"scroll\">\n<button data-copy>copy table</button>\n<table>\n");
        let _ = writeln!(html, "<caption>{}</caption>\n<thead><tr>", escape(&self.caption));
        let words: Vec<bool> = (0..self.head.len()).map(|column| self.has_words(column)).collect();
        for (head, words) in self.head.iter().zip(&words) {
            let class = if *words { " class=\"words\"" } else { "" };
            let _ = write!(html, "<th{class}>{}</th>", escape(head));
        }
        html.push_str("</tr></thead>\n<tbody>\n");
        for row in &self.rows {
            html.push_str("<tr>");
            for (column, cell) in row.iter().enumerate() {
                let class = match (cell.best, words.get(column)) {
                    (true, _) => " class=\"best\"",
                    (false, Some(true)) => " class=\"words\"",
                    _ => "",
                };
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

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn property_words_begin_on_the_left_and_numbers_end_on_the_right() {
        let mut table = Table::new("errors", &["model", "layer", "z [m]", "outcome"]);
        table.row(["a", "soil", "0.1", ""].map(Cell::from).into()).row(["b", "map", "–", "chosen"].map(Cell::from).into());
        let html = table.to_html();
        let class = |cell: &str| html.contains(&format!("<td class=\"words\">{cell}</td>"));
        assert!(class("soil") && class("map") && class("chosen") && html.contains("<th class=\"words\">layer</th>"), "{html}");
        assert!(!class("0.1") && !class("–") && html.contains("<td>0.1</td>") && html.contains("<th>z [m]</th>"), "{html}");
    }
}
