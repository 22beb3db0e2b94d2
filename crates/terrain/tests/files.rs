//! World folders: the committed Chrono sample, and folders damaged in every way that a reader meets.
#![allow(clippy::unwrap_used)]

use std::path::{Path, PathBuf};

use nesam_terrain::{TerrainError, WorldMap, read_gray8};
use tempfile::TempDir;

const WIDTH: u32 = 5;
const HEIGHT: u32 = 4;

fn sample_world() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("../../tests/data/chrono_sample/worlds/w05")
}

fn write_png(path: &Path, colour: png::ColorType, depth: png::BitDepth, width: u32, height: u32, bytes: &[u8]) {
    let mut encoder = png::Encoder::new(std::fs::File::create(path).unwrap(), width, height);
    encoder.set_color(colour);
    encoder.set_depth(depth);
    encoder.write_header().unwrap().write_image_data(bytes).unwrap();
}

fn world_json() -> serde_json::Value {
    serde_json::json!({
        "world": "tiny", "resolution_m": 0.5, "width_px": WIDTH, "height_px": HEIGHT, "origin_m": [-1.0, 2.0],
        "elevation": {"scale_m": 0.001, "offset_m": -3.0},
        "soil_prior_ranges": {"sand": {"Kphi": [1e6, 2e6], "Kc": [1e3, 2e3], "n": [0.9, 1.1], "c": [300, 400], "phi": [27, 30], "K": [0.01, 0.02]}}
    })
}

/// A small valid world: pixel (column i, image row j) has the gray value 1000 j + i.
fn tiny_world() -> TempDir {
    let dir = TempDir::new().unwrap();
    let gray: Vec<u8> = (0..HEIGHT * WIDTH).flat_map(|k| (1000 * (k / WIDTH) as u16 + (k % WIDTH) as u16).to_be_bytes()).collect();
    write_png(&dir.path().join("elevation.png"), png::ColorType::Grayscale, png::BitDepth::Sixteen, WIDTH, HEIGHT, &gray);
    let rgb: Vec<u8> = (0..HEIGHT * WIDTH).flat_map(|k| [k as u8, 100, 200]).collect();
    write_png(&dir.path().join("semantic.png"), png::ColorType::Rgb, png::BitDepth::Eight, WIDTH, HEIGHT, &rgb);
    std::fs::write(dir.path().join("world.json"), world_json().to_string()).unwrap();
    dir
}

fn refusal(dir: &TempDir) -> String {
    WorldMap::load(dir.path()).unwrap_err().to_string()
}

#[test]
fn analytic_image_rows_are_flipped_to_south_first() {
    let dir = tiny_world();
    let map = WorldMap::load(dir.path()).unwrap();
    // Image row 0 is the north row: y = 2 + 0.5 * 3. Gray 1000 j + i, scale 1 mm, offset -3 m.
    assert!((map.height_m(-1.0, 3.5).unwrap() + 3.0).abs() < 1e-6);
    assert!((map.height_m(-1.0, 2.0).unwrap() - 0.0).abs() < 1e-6);
    assert!((map.height_m(1.0, 2.0).unwrap() - 0.004).abs() < 1e-6);
    assert_eq!(map.semantic_rgb().unwrap()[0], [15, 100, 200], "cell 0 is the south-west corner");
    let sand = &map.soil_classes()[0];
    assert_eq!((sand.name.as_str(), sand.low[0], sand.high[5]), ("sand", 1e6, 0.02));
    assert!((sand.low[4] - 27f64.to_radians()).abs() < 1e-12, "the friction angle is converted to rad");
}

#[test]
fn analytic_world_without_semantics_is_valid() {
    let dir = tiny_world();
    std::fs::remove_file(dir.path().join("semantic.png")).unwrap();
    assert!(!WorldMap::load(dir.path()).unwrap().has_semantics());
}

#[test]
fn regress_damaged_images_name_file_and_row() {
    for (file, of) in [("elevation.png", "16-bit"), ("semantic.png", "8-bit")] {
        let whole = std::fs::read(tiny_world().path().join(file)).unwrap();
        for keep in 0..whole.len() {
            let dir = tiny_world();
            std::fs::write(dir.path().join(file), &whole[..keep]).unwrap();
            assert!(refusal(&dir).contains(file), "{of} cut at {keep}");
        }
        let dir = tiny_world();
        write_png(&dir.path().join(file), png::ColorType::Grayscale, png::BitDepth::Eight, WIDTH, HEIGHT, &[0; 20]);
        let error = refusal(&dir);
        assert!(error.contains(file) && error.contains(of), "{error}");
        let dir = tiny_world();
        write_png(&dir.path().join(file), png::ColorType::Rgb, png::BitDepth::Sixteen, 2, 2, &[0; 24]);
        assert!(refusal(&dir).contains("2 x 2 pixels, world.json says 5 x 4"));
    }
    let dir = tiny_world();
    std::fs::remove_file(dir.path().join("elevation.png")).unwrap();
    assert!(matches!(WorldMap::load(dir.path()), Err(TerrainError::Read { .. })));

    // A real map, cut in the middle and with a flipped byte: the row is named.
    let whole = std::fs::read(sample_world().join("gt_region.png")).unwrap();
    let dir = TempDir::new().unwrap();
    let path = dir.path().join("gt_region.png");
    std::fs::write(&path, &whole[..whole.len() / 2]).unwrap();
    let error = read_gray8(&path, 801, 801).unwrap_err().to_string();
    assert!(error.contains("gt_region.png") && error.contains("row"), "{error}");
    let mut flipped = whole.clone();
    flipped[whole.len() / 2] ^= 0x55;
    std::fs::write(&path, &flipped).unwrap();
    assert!(read_gray8(&path, 801, 801).is_err());
}

#[test]
fn regress_bad_world_json_names_the_key() {
    let with = |pointer: &str, value: serde_json::Value| {
        let dir = tiny_world();
        let mut json = world_json();
        let (parent, key) = pointer.rsplit_once('/').unwrap();
        let object = json.pointer_mut(parent).unwrap().as_object_mut().unwrap();
        if value == serde_json::json!("REMOVE") {
            object.remove(key)
        } else {
            object.insert(key.into(), value)
        };
        std::fs::write(dir.path().join("world.json"), json.to_string()).unwrap();
        refusal(&dir)
    };
    let remove = || serde_json::json!("REMOVE");
    for (pointer, key) in [
        ("/resolution_m", "`resolution_m`"),
        ("/width_px", "`width_px`"),
        ("/height_px", "`height_px`"),
        ("/origin_m", "`origin_m`"),
        ("/elevation/scale_m", "`elevation.scale_m`"),
        ("/elevation/offset_m", "`elevation.offset_m`"),
        ("/soil_prior_ranges/sand/phi", "`soil_prior_ranges.sand.phi`"),
    ] {
        for value in [remove(), serde_json::json!("text"), serde_json::json!([1, "two"]), serde_json::json!(null)] {
            let error = with(pointer, value.clone());
            assert!(error.contains("world.json") && error.contains(key), "{pointer} = {value}: {error}");
        }
    }
    assert!(with("/resolution_m", serde_json::json!(0)).contains("resolution_m"));
    assert!(with("/elevation/scale_m", serde_json::json!(0)).contains("elevation.scale_m"));
    assert!(with("/width_px", serde_json::json!(-5)).contains("width_px"));
    assert!(with("/width_px", serde_json::json!(1u64 << 60)).contains("width_px"));
    assert!(with("/elevation/file", serde_json::json!("../../etc/passwd")).contains("elevation.file"));

    let dir = tiny_world();
    std::fs::write(dir.path().join("world.json"), world_json().to_string().replace("-1.0", "NaN")).unwrap();
    assert!(refusal(&dir).contains("not valid json"));
    std::fs::write(dir.path().join("world.json"), world_json().to_string().replace("-1.0", "1e999")).unwrap();
    assert!(refusal(&dir).contains("world.json"));
}

#[test]
fn chrono_sample_world_agrees_with_its_description() {
    let map = WorldMap::load(&sample_world()).unwrap();
    assert_eq!((map.id(), map.version(), map.geometry().cells()), ("w05", 1, 801 * 801));
    assert_eq!(map.soil_classes().len(), 5);
    assert_eq!(map.soil_classes()[0].name, "grass");
    assert_eq!(map.soil_classes()[2].colour, Some([214, 190, 140]));
    assert!(map.contains(-40.0, 40.0) && map.contains(40.0, -40.0));
    assert!(map.soil_class(-40.0, 40.0).is_some() && map.soil_class(40.1, 0.0).is_none());
    let found: std::collections::BTreeSet<&str> = (0..400)
        .filter_map(|k| map.soil_class(-38.0 + 4.0 * f64::from(k % 20), -38.0 + 4.0 * f64::from(k / 20)))
        .map(|c| c.name.as_str())
        .collect();
    assert_eq!(found.len(), 5, "all five classes of the world: {found:?}");
    // Steepest 5 % of a world: 18 degrees at most (DATA.md); ours is smoothed over less than their 0.5 m.
    let mut slopes: Vec<f64> = (0..10_000)
        .map(|k| map.ground(-39.0 + 0.78 * f64::from(k % 100), -39.0 + 0.78 * f64::from(k / 100)).unwrap())
        .map(|g| g.slope_x.hypot(g.slope_y).atan().to_degrees())
        .collect();
    slopes.sort_by(f64::total_cmp);
    assert!((4.0..20.0).contains(&slopes[9500]), "{}", slopes[9500]);
}
