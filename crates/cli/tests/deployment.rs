//! Goal: what is shipped for operators does what it says. Method: the real binary; with everything that has metrics on, every metric that
//! the alert rules and the dashboard name is among those of `/metrics`.
#![allow(clippy::unwrap_used)]

mod common;

use std::collections::BTreeSet;
use std::io::{Read, Write};
use std::net::TcpStream;

/// Words that begin like a metric.
fn metrics_of(text: &str) -> BTreeSet<String> {
    let words = text.split(|c: char| !(c.is_ascii_lowercase() || c.is_ascii_digit() || c == '_'));
    words.filter(|w| w.starts_with("nesam_") && w.len() > "nesam_".len()).map(str::to_string).collect()
}

fn get(address: &str, path: &str) -> String {
    let mut stream = TcpStream::connect(address).unwrap();
    write!(stream, "GET {path} HTTP/1.1\r\nHost: {address}\r\nConnection: close\r\n\r\n").unwrap();
    let mut text = String::new();
    stream.read_to_string(&mut text).unwrap();
    text
}

#[test]
fn service_rules_and_dashboard_name_metrics_that_exist() {
    let here = tempfile::tempdir().unwrap();
    let (mut server, lines) = common::start(here.path(), &["--http", "127.0.0.1:0", "--store", "store", "--record", "run"]);
    let page = common::told(&lines, "http").unwrap_or_else(|| panic!("{lines:?}")).trim_start_matches("http://");
    let told = get(page.split(['/', ' ']).next().unwrap(), "/metrics");
    server.kill().unwrap();
    server.wait().unwrap();
    let kinds: BTreeSet<&str> = told.lines().filter_map(|l| l.strip_prefix("# TYPE ")?.split(' ').next()).collect();
    assert!(kinds.len() > 8, "{told}");
    for file in ["deploy/prometheus/rules.yaml", "deploy/grafana/nesam.json"] {
        let text = std::fs::read_to_string(common::repository().join(file)).unwrap();
        let named = metrics_of(&text);
        assert!(named.len() > 4, "{file}: {named:?}");
        for metric in named {
            let known = kinds.contains(metric.as_str()) || metric.strip_suffix("_bucket").is_some_and(|m| kinds.contains(m));
            assert!(known, "{file} watches {metric}, which /metrics does not tell: {kinds:?}");
        }
    }
}

/// Goal: relative paths, such as that of diagnoses, are where the sandboxed service may write. Method: its folder is its state directory, and that of its store.
#[test]
fn regress_the_unit_runs_in_the_folder_that_it_may_write() {
    let unit = std::fs::read_to_string(common::repository().join("deploy/systemd/nesam.service")).unwrap();
    let value = |key: &str| unit.lines().find_map(|line| line.strip_prefix(key)?.strip_prefix('=')).unwrap();
    let state = format!("/var/lib/{}", value("StateDirectory"));
    assert_eq!(value("WorkingDirectory"), state);
    for command in ["ExecStartPre", "ExecStart"] {
        assert!(value(command).ends_with(&format!("--store {state}")), "{command}");
    }
}

/// A server that ends at once where what it needs is not there yet, such as a router, is started again as long as it takes.
#[test]
fn regress_the_unit_is_started_again_without_end() {
    let unit = std::fs::read_to_string(common::repository().join("deploy/systemd/nesam.service")).unwrap();
    let (of_unit, of_service) = unit.split_once("[Service]").unwrap();
    assert!(of_unit.lines().any(|line| line == "StartLimitIntervalSec=0"), "the default gives up after five starts in 10 s");
    let pause_s = of_service.lines().find_map(|line| line.strip_prefix("RestartSec=")?.parse::<u32>().ok());
    assert!(pause_s.is_some_and(|s| s >= 5) && of_service.lines().any(|line| line == "Restart=always"), "{pause_s:?}");
}

/// Goal: no replica of the chart is killed for memory that the default limits allow. Method: what docs/capacity.md and deploy/config/default.toml say that things take.
#[test]
fn analytic_the_chart_gives_the_memory_that_the_default_limits_allow() {
    let values = std::fs::read_to_string(common::repository().join("deploy/helm/nesam/values.yaml")).unwrap();
    let limit =
        values.split("resources:").nth(1).and_then(|rest| rest.split("limits: {memory: ").nth(1)).and_then(|rest| rest.split("Gi}").next());
    let limit_bytes = f64::from(1 << 30) * limit.and_then(|text| text.parse::<f64>().ok()).expect("a limit in Gi");
    let config = nesam_server::Config::default();
    let (sessions, cells, uploads) = (config.limits.sessions_max, config.limits.map_cells_total_max, config.grpc.uploads_max);
    let terrain_bytes = 3.5e9;
    let needed_bytes = 90e3 * sessions as f64 + 16.0 * cells as f64 + 120e6 * uploads as f64 + terrain_bytes;
    assert!(limit_bytes > needed_bytes, "{limit_bytes} of {needed_bytes} bytes");
}

/// Three workers over the processors that this process may use: each stays on one, and none has more than its share.
#[test]
#[cfg(target_os = "linux")]
fn service_pinned_workers_stay_on_one_processor_each() {
    let here = tempfile::tempdir().unwrap();
    std::fs::write(here.path().join("pinned.toml"), "[workers]\nthreads = 3\npinned = true\n").unwrap();
    let (mut server, _) = common::start(here.path(), &["--no-http", "--config", "pinned.toml"]);
    let tasks = std::fs::read_dir(format!("/proc/{}/task", server.id())).unwrap();
    let mut processors = Vec::new();
    for task in tasks.flatten() {
        let read = |name: &str| std::fs::read_to_string(task.path().join(name)).unwrap_or_default();
        if read("comm").starts_with("nesam-worker") {
            let allowed =
                read("status").lines().find_map(|line| line.strip_prefix("Cpus_allowed_list:").map(|list| list.trim().to_string()));
            processors.push(allowed.unwrap());
        }
    }
    server.kill().unwrap();
    server.wait().unwrap();
    assert_eq!(processors.len(), 3, "{processors:?}");
    assert!(processors.iter().all(|list| list.parse::<usize>().is_ok()), "one processor each: {processors:?}");
    let distinct: BTreeSet<_> = processors.iter().collect();
    let available = std::thread::available_parallelism().unwrap().get();
    assert_eq!(distinct.len(), available.min(3));
}

/// The system must not make huge pages of what a server has given back (ADR 0056).
#[test]
#[cfg(target_os = "linux")]
fn service_memory_of_a_server_is_not_gathered_into_huge_pages() {
    let here = tempfile::tempdir().unwrap();
    let (mut server, _) = common::start(here.path(), &["--no-http"]);
    let status = std::fs::read_to_string(format!("/proc/{}/status", server.id())).unwrap();
    server.kill().unwrap();
    server.wait().unwrap();
    let enabled = status.lines().find_map(|line| line.strip_prefix("THP_enabled:"));
    // Kernels before 5.0 do not tell.
    assert!(enabled.is_none_or(|value| value.trim() == "0"), "{enabled:?}");
}
