//! Line plots as inline SVG.

use std::fmt::Write;

use super::page::escape;
use super::scale::{Linear, label, ticks};

/// One line of a plot.
#[derive(Clone, Debug, Default)]
pub struct Series {
    /// Name in the legend and in hover texts.
    pub name: String,
    /// Index of the look: colour and dash, 0 = ink, no two of the first 21 alike.
    pub colour: usize,
    /// Points.
    pub points: Vec<(f64, f64)>,
    /// Band (x, low, high) drawn behind the line; may be empty.
    pub band: Vec<(f64, f64, f64)>,
    /// Draws a dot at the first point.
    pub mark_start: bool,
}

impl Series {
    /// A plain line.
    pub fn line(name: &str, colour: usize, points: Vec<(f64, f64)>) -> Self {
        Self { name: name.into(), colour, points, ..Self::default() }
    }

    /// Each time the colours are through they come with other dashes.
    fn dash(&self) -> &'static str {
        let count = DASHES.len();
        DASHES[(self.colour + 2 * (self.colour / count)) % count]
    }
}

/// A plot with axes, grid, lines, bands and hover values.
#[derive(Clone, Debug, Default)]
pub struct LinePlot {
    /// Title above the frame.
    pub title: String,
    /// Label of the horizontal axis, with its unit.
    pub x_label: String,
    /// Label of the vertical axis, with its unit.
    pub y_label: String,
    /// Lines, drawn in order.
    pub series: Vec<Series>,
    /// Same metres per pixel on both axes (paths).
    pub equal_aspect: bool,
    /// The vertical axis begins at zero (errors).
    pub from_zero: bool,
}

const WIDTH: f64 = 380.0;
const HEIGHT: f64 = 260.0;
const LEFT: f64 = 62.0;
const RIGHT: f64 = 10.0;
const TOP: f64 = 24.0;
const BOTTOM: f64 = 38.0;
const DASHES: [&str; 7] = ["", "", "7 3", "2 3", "9 3 2 3", "4 4", "1 2"];

impl LinePlot {
    /// An empty plot.
    pub fn new(title: &str, x_label: &str, y_label: &str) -> Self {
        Self { title: title.into(), x_label: x_label.into(), y_label: y_label.into(), ..Self::default() }
    }

    pub(super) fn legend_html(&self) -> String {
        let mut html = String::from("<div class=\"legend\">");
        for s in &self.series {
            let _ = write!(
                html,
                "<span><svg viewBox=\"0 0 34 10\"><path class=\"line s{}\" stroke-dasharray=\"{}\" d=\"M1 5H33\"/></svg>{}</span>",
                s.colour % DASHES.len(),
                s.dash(),
                escape(&s.name)
            );
        }
        html.push_str("</div>\n");
        html
    }

    pub(super) fn to_svg(&self) -> String {
        let (x_range, y_range) = self.ranges();
        let x = Linear::new(x_range, [LEFT, WIDTH - RIGHT]);
        let y = Linear::new(y_range, [HEIGHT - BOTTOM, TOP]);
        let near = if self.equal_aspect { "point" } else { "abscissa" };
        let mut svg = format!(
            "<svg class=\"plot\" viewBox=\"0 0 {WIDTH} {HEIGHT}\" role=\"img\" aria-label=\"{}\" data-near=\"{near}\" data-frame=\"{LEFT} {TOP} {} {}\">\n",
            escape(&self.title),
            WIDTH - RIGHT,
            HEIGHT - BOTTOM
        );
        self.axes(&mut svg, x_range, y_range, &x, &y);
        for s in &self.series {
            draw_band(&mut svg, s, &x, &y);
        }
        for s in &self.series {
            draw_line(&mut svg, s, &x, &y);
        }
        for s in &self.series {
            draw_hits(&mut svg, s, &x, &y);
        }
        svg.push_str("</svg>\n");
        svg
    }

    /// Ranges of the two axes with a margin, widened to equal scales where asked for.
    fn ranges(&self) -> ([f64; 2], [f64; 2]) {
        let points = || self.series.iter().flat_map(|s| s.points.iter().copied());
        let bands = || self.series.iter().flat_map(|s| s.band.iter().flat_map(|(_, low, high)| [*low, *high]));
        let mut x = bounds(points().map(|p| p.0), 0.0);
        let mut y = bounds(points().map(|p| p.1).chain(bands()), 0.05);
        if self.from_zero {
            y[0] = 0.0;
        }
        if self.equal_aspect {
            let scale = ((x[1] - x[0]) / (WIDTH - LEFT - RIGHT)).max((y[1] - y[0]) / (HEIGHT - TOP - BOTTOM)) * 1.06;
            x = about(x, scale * (WIDTH - LEFT - RIGHT));
            y = about(y, scale * (HEIGHT - TOP - BOTTOM));
        }
        (x, y)
    }

    fn axes(&self, svg: &mut String, x_range: [f64; 2], y_range: [f64; 2], x: &Linear, y: &Linear) {
        let (bottom, right) = (HEIGHT - BOTTOM, WIDTH - RIGHT);
        let (xs, ys) = (ticks(x_range[0], x_range[1], 6), ticks(y_range[0], y_range[1], 5));
        let step = |t: &[f64]| if t.len() > 1 { t[1] - t[0] } else { 1.0 };
        for &t in &xs {
            let at = x.at(t);
            let _ = writeln!(svg, "<path class=\"grid\" d=\"M{at:.1} {TOP}V{bottom}\"/>");
            let text = label(t, step(&xs));
            let _ = writeln!(svg, "<text x=\"{at:.1}\" y=\"{:.1}\" text-anchor=\"middle\">{text}</text>", bottom + 14.0);
        }
        for &t in &ys {
            let at = y.at(t);
            let _ = writeln!(svg, "<path class=\"grid\" d=\"M{LEFT} {at:.1}H{right}\"/>");
            let text = label(t, step(&ys));
            let _ = writeln!(svg, "<text x=\"{:.1}\" y=\"{:.1}\" text-anchor=\"end\">{text}</text>", LEFT - 5.0, at + 4.0);
        }
        let _ = writeln!(svg, "<rect class=\"frame\" x=\"{LEFT}\" y=\"{TOP}\" width=\"{}\" height=\"{}\"/>", right - LEFT, bottom - TOP);
        let _ = writeln!(svg, "<text class=\"title\" x=\"{LEFT}\" y=\"15\">{}</text>", escape(&self.title));
        let middle = 0.5 * (LEFT + right);
        let _ = writeln!(svg, "<text x=\"{middle}\" y=\"{}\" text-anchor=\"middle\">{}</text>", HEIGHT - 6.0, escape(&self.x_label));
        let half = 0.5 * (TOP + bottom);
        let _ = writeln!(
            svg,
            "<text x=\"12\" y=\"{half}\" text-anchor=\"middle\" transform=\"rotate(-90 12 {half})\">{}</text>",
            escape(&self.y_label)
        );
    }
}

/// Smallest and largest finite value with a share of margin on both sides; never an empty range.
fn bounds(values: impl Iterator<Item = f64>, margin: f64) -> [f64; 2] {
    let (low, high) = values.filter(|v| v.is_finite()).fold((f64::INFINITY, f64::NEG_INFINITY), |(l, h), v| (l.min(v), h.max(v)));
    if low > high {
        return [0.0, 1.0];
    }
    let span = (high - low).max(1e-6 * low.abs().max(high.abs())).max(1e-9);
    [low - margin * span, high + margin * span]
}

fn about(range: [f64; 2], span: f64) -> [f64; 2] {
    let middle = 0.5 * (range[0] + range[1]);
    [middle - 0.5 * span, middle + 0.5 * span]
}

fn path(points: impl Iterator<Item = (f64, f64)>, x: &Linear, y: &Linear) -> String {
    let mut d = String::new();
    for (px, py) in points.filter(|p| p.0.is_finite() && p.1.is_finite()) {
        let verb = if d.is_empty() { 'M' } else { 'L' };
        let _ = write!(d, "{verb}{:.1} {:.1}", x.at(px), y.at(py));
    }
    d
}

fn draw_band(svg: &mut String, s: &Series, x: &Linear, y: &Linear) {
    if s.band.is_empty() {
        return;
    }
    let there = s.band.iter().map(|b| (b.0, b.2));
    let back = s.band.iter().rev().map(|b| (b.0, b.1));
    let _ = writeln!(svg, "<path class=\"band s{}\" d=\"{}Z\"/>", s.colour % DASHES.len(), path(there.chain(back), x, y));
}

fn draw_line(svg: &mut String, s: &Series, x: &Linear, y: &Linear) {
    let c = s.colour % DASHES.len();
    let d = path(s.points.iter().copied(), x, y);
    let _ = writeln!(svg, "<path class=\"line s{c}\" stroke-dasharray=\"{}\" d=\"{d}\"/>", s.dash());
    if let (true, Some((px, py))) = (s.mark_start, s.points.first()) {
        let _ = writeln!(svg, "<circle class=\"s{c}\" cx=\"{:.1}\" cy=\"{:.1}\" r=\"3.5\"/>", x.at(*px), y.at(*py));
    }
}

/// Invisible discs that carry the values as tooltips.
fn draw_hits(svg: &mut String, s: &Series, x: &Linear, y: &Linear) {
    for (i, (px, py)) in s.points.iter().enumerate().filter(|(_, p)| p.0.is_finite() && p.1.is_finite()) {
        let band = s.band.get(i).map_or(String::new(), |b| format!(" [{:.4}, {:.4}]", b.1, b.2));
        let _ = writeln!(
            svg,
            "<circle class=\"hit\" cx=\"{:.1}\" cy=\"{:.1}\" r=\"5\"><title>{}: {px:.2}, {py:.4}{band}</title></circle>",
            x.at(*px),
            y.at(*py),
            escape(&s.name)
        );
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn analytic_as_many_models_as_there_are_look_different() {
        let looks: std::collections::BTreeSet<_> = (0..21).map(|i| (i % DASHES.len(), Series::line("", i, Vec::new()).dash())).collect();
        assert_eq!(looks.len(), 21);
    }
}
