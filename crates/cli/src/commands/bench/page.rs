//! The report of `nesam bench predict`, made from its JSON.

use nesam_evaluation::Provenance;
use nesam_evaluation::report::{LinePlot, Page, Series, Table};
use serde_json::Value;

/// Key of the JSON, what it is, its unit.
const ROWS: [(&str, &str, &str); 8] = [
    ("/p50_ms", "warm, new pose and new commands each: median", "ms"),
    ("/p99_ms", "the same: 99 % of the queries are faster", "ms"),
    ("/min_ms", "the same: fastest", "ms"),
    ("/processor_ms", "the same: processor time of all threads, mean", "ms"),
    ("/steady_p50_ms", "replans along a drive over new ground: median", "ms"),
    ("/cold_ms", "first query on an unseen map", "ms"),
    ("/tokens_per_s", "tokens per second, warm", "1/s"),
    ("/terrain_cache/hit_rate", "terrain lookups that needed no encoding, warm", "share"),
];

/// The page. What was not measured is a dash.
pub(super) fn predict_page(figures: &Value, provenance: &Provenance) -> String {
    let whole = |key: &str| figures[key].to_string();
    let lead = format!(
        "What a planner's query costs on this machine: {} candidates of {} steps, {} queries of each kind, {} threads, {} instructions.",
        whole("samples"),
        whole("horizon"),
        whole("queries"),
        whole("threads"),
        figures["path"].as_str().unwrap_or("unknown"),
    );
    let mut page = Page::new("nesam bench predict", &lead);
    let number =
        |value: &Value| value.as_f64().map_or("–".into(), |v| if v.abs() >= 1000.0 { format!("{v:.0}") } else { format!("{v:.3}") });
    let mut table = Table::new("Wall time of whole queries unless another is named", &["", "figure", "unit"]);
    for (pointer, what, unit) in ROWS {
        table.row(vec![what.into(), figures.pointer(pointer).map_or("–".into(), &number).into(), unit.into()]);
    }
    page.section("Queries").table(&table);
    if let Some(parts) = figures["parts_ms"].as_object() {
        let mut table = Table::new("Processor time of a warm query by parts, medians, all threads together", &["part", "ms"]);
        for (part, value) in parts {
            table.row(vec![part.as_str().into(), number(value).into()]);
        }
        page.section("Where the time goes").table(&table);
    }
    if let Some(rows) = figures["sweep"].as_array() {
        page.section("By candidates and instructions")
            .plots(&[sweep_plot(rows)], "Median of warm queries.")
            .table(&sweep_table(rows, &number));
    }
    page.made_from(provenance);
    page.render()
}

fn sweep_plot(rows: &[Value]) -> LinePlot {
    let mut plot = LinePlot::new("query time", "candidates", "ms");
    plot.from_zero = true;
    for row in rows {
        let (name, point) = (row["path"].as_str().unwrap_or_default(), row["samples"].as_f64().zip(row["p50_ms"].as_f64()));
        let at = plot.series.iter().position(|series| series.name == name).unwrap_or_else(|| {
            plot.series.push(Series::line(name, plot.series.len() + 1, Vec::new()));
            plot.series.len() - 1
        });
        plot.series[at].points.extend(point);
    }
    plot
}

fn sweep_table(rows: &[Value], number: &dyn Fn(&Value) -> String) -> Table {
    let mut table = Table::new("Warm queries", &["instructions", "candidates", "median ms", "fastest ms"]);
    for row in rows {
        let path = row["path"].as_str().unwrap_or_default();
        table.row(vec![path.into(), row["samples"].to_string().into(), number(&row["p50_ms"]).into(), number(&row["min_ms"]).into()]);
    }
    table
}

#[cfg(test)]
mod tests {
    use serde_json::json;

    use super::*;

    #[test]
    fn property_the_page_has_the_figures_and_says_what_is_missing() {
        let figures = json!({
            "samples": 1024, "horizon": 32, "queries": 3, "threads": 2, "path": "avx2", "p50_ms": 12.3456, "terrain_cache": {"hit_rate": null},
            "sweep": [{"path": "avx2", "samples": 64, "p50_ms": 1.5, "min_ms": 1.25}, {"path": "portable", "samples": 64, "p50_ms": 3.0, "min_ms": 2.0}],
        });
        let [command, bundle, bundle_hash] = ["nesam bench predict", "b", "h"].map(String::from);
        let page = predict_page(&figures, &Provenance { command, bundle, bundle_hash, ..Provenance::default() });
        for expected in
            ["1024 candidates of 32 steps", "12.346", "<td>–", "portable", "<code>nesam bench predict</code>", "<code>b h</code>"]
        {
            assert!(page.contains(expected), "`{expected}` is not in the page");
        }
        assert!(!page.contains("Where the time goes"));
    }
}
