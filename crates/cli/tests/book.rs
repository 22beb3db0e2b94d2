//! Goal: the book leads somewhere. Method: every shell block after `<!-- run -->` is run with the real binary, every link within the book is followed.
#![allow(clippy::unwrap_used)]

mod common;

use std::path::{Path, PathBuf};
use std::process::Command;

use common::repository;
use nesam_adaptation::FilterSettings;

/// Markdown files of the book, those of its folders included: decisions, results.
fn pages() -> Vec<PathBuf> {
    let of = |folder: &Path| -> Vec<PathBuf> { std::fs::read_dir(folder).unwrap().map(|entry| entry.unwrap().path()).collect() };
    let docs = of(&repository().join("docs"));
    let below = docs.iter().filter(|path| path.is_dir()).flat_map(|folder| of(folder));
    docs.iter().cloned().chain(below).filter(|path| path.extension().is_some_and(|e| e == "md")).collect()
}

/// Shell blocks that are marked to be run.
fn commands(text: &str) -> Vec<&str> {
    let blocks = text.split("<!-- run -->\n```sh\n").skip(1);
    blocks.map(|rest| rest.split("```").next().unwrap()).collect()
}

#[test]
fn service_commands_of_the_book_run() {
    let binary = Path::new(env!("CARGO_BIN_EXE_nesam")).parent().unwrap().to_path_buf();
    let path = format!("{}:{}", binary.display(), std::env::var("PATH").unwrap_or_default());
    let mut ran = 0;
    for page in pages() {
        let text = std::fs::read_to_string(&page).unwrap();
        let folder = tempfile::tempdir().unwrap();
        for block in commands(&text) {
            let output = Command::new("bash")
                .args(["-euo", "pipefail", "-c", block])
                .current_dir(folder.path())
                .env("PATH", &path)
                .env("REPO", repository())
                .output()
                .unwrap();
            let said = format!("{}{}", String::from_utf8_lossy(&output.stdout), String::from_utf8_lossy(&output.stderr));
            assert!(output.status.success(), "{}:\n{block}\n{said}", page.display());
            assert!(!said.contains("doubt:"), "{}:\n{block}\n{said}", page.display());
            ran += 1;
        }
    }
    assert!(ran >= 3, "{ran} blocks were run");
}

/// Files that a page links to.
fn files_linked(page: &str) -> impl Iterator<Item = &str> {
    let targets = page.split("](").skip(1).filter_map(|rest| rest.split(')').next()).filter_map(|link| link.split('#').next());
    targets.filter(|target| !target.is_empty() && !target.contains("://") && !target.contains(' '))
}

#[test]
fn property_links_of_the_first_pages_lead_to_files() {
    for page in ["README.md", "ARCHITECTURE.md", "CONTRIBUTING.md", "CHANGELOG.md"] {
        let text = std::fs::read_to_string(repository().join(page)).unwrap();
        for target in files_linked(&text) {
            assert!(repository().join(target).exists(), "{page}: `{target}` leads nowhere");
        }
    }
}

#[test]
fn property_links_of_the_book_lead_to_files() {
    let docs = repository().join("docs");
    for page in pages() {
        let text = std::fs::read_to_string(&page).unwrap();
        for target in files_linked(&text) {
            let there = page.parent().unwrap().join(target).canonicalize();
            assert!(there.is_ok_and(|path| path.starts_with(&docs)), "{}: `{target}` leads nowhere in the book", page.display());
        }
    }
    let summary = std::fs::read_to_string(repository().join("docs/SUMMARY.md")).unwrap();
    for page in pages() {
        let name = page.strip_prefix(&docs).unwrap().display().to_string();
        assert!(name == "SUMMARY.md" || summary.contains(&format!("({name})")), "{name} is not in the book");
    }
}

/// Goal: every setting of the soil filter is explained. Method: the keys that a settings file may have, as the filter refuses all others.
#[test]
fn property_every_setting_of_the_soil_filter_is_in_the_book() {
    let page = std::fs::read_to_string(repository().join("docs/soil-filter.md")).unwrap();
    let refused = FilterSettings::from_json(r#"{"no_such_setting": 1}"#).unwrap_err().to_string();
    let (_, expected) = refused.split_once("expected one of ").unwrap();
    let keys: Vec<&str> = expected.split('`').skip(1).step_by(2).collect();
    assert!(keys.len() > 20, "{refused}");
    for key in keys {
        assert!(page.contains(&format!("`{key}`")), "{key}");
    }
}
