//! Goal: `docs/effects.md` lists the catalogue as it is. Method: the page is made here and compared; `cargo test --release --workspace --test effects -- --ignored
//! write_the_page` writes it.

use std::fmt::Write;
use std::path::PathBuf;

use nesam_physics::effects::{Effect, Scaling};

fn path() -> PathBuf {
    PathBuf::from(env!("CARGO_MANIFEST_DIR")).join("../../docs/effects.md")
}

fn page() -> String {
    let mut text = String::from(
        "# Catalogue of effects\n\nMade by `crates/physics/tests/effects/page.rs`. What a bundle's `effects.toml` may list, for instance\n\n```toml\nformat = \"nesam.effects/1\"\n\n\
         [[effects]]\nid = \"steering_delay\"\nonset_s = 12.5          # s since the start of the log; left out: always\nparameters = { seconds = 0.15 }\n```\n\n\
         Equations, sources and what each neglects stand in `crates/physics/src/effects/<layer>/<id>.rs`. Values outside a range are refused. A *place* says where or how,\n\
         not how much; an effect is absent when its sizes are 0, its factors 1, its limits infinite. What the catalogue lacks can be [written down](your-own-effect.md).\n\n\
         Entries of one effect add up, each at its place: `soil_drift`, `soil_crust` and `free_form` at four places at most. `map_tilt` turns about the middle of the map, `multi_pass` and\n\
         `front_bulldozing` turn round with the direction of travel. Effects that leave a vehicle no mass or no inertia, or delay its commands by more than twelve steps, are refused.\n\n| id | layer | parameter | unit | range | kind |\n|---|---|---|---|---|---|\n",
    );
    for effect in Effect::examples() {
        for (n, q) in effect.quantities().iter().enumerate() {
            let (id, layer) = if n == 0 { (format!("`{}`", effect.id()), effect.layer().as_str()) } else { Default::default() };
            let kind = match q.scaling {
                Scaling::Size => "size",
                Scaling::Factor => "factor",
                Scaling::Limit => "limit",
                Scaling::Held => "place",
            };
            let [low, high] = q.range;
            writeln!(text, "| {id} | {layer} | `{}` | {} | {low} … {high} | {kind} |", q.name, q.unit).unwrap();
        }
    }
    text
}

#[test]
fn regress_the_page_of_effects_is_current() {
    let found = std::fs::read_to_string(path()).unwrap();
    assert_eq!(found, page(), "docs/effects.md is stale; see this file's first lines");
}

#[test]
#[ignore = "writes docs/effects.md"]
fn write_the_page() {
    std::fs::write(path(), page()).unwrap();
}
