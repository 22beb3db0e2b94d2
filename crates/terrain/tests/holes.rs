//! Holes of elevation layers: what is filled, how well, and where it counts as known.
#![allow(clippy::unwrap_used)]

use nesam_terrain::{GridGeometry, Patch, PatchScale, Pose2, WorldMap, sample_patch};

/// How far from known ground a hole counts as known, m (ADR 0076).
const BELIEVED_M: f64 = 0.5;

/// Cells along each side: 12 m at 0.1 m.
const SIDE: usize = 121;

fn grid() -> GridGeometry {
    GridGeometry { origin_m: [-6.0, -6.0], resolution_m: 0.1, width: SIDE, height: SIDE }
}

/// Pseudo-random numbers in 0..1 (splitmix64).
struct Random(u64);

impl Random {
    fn next(&mut self) -> f64 {
        self.0 = self.0.wrapping_add(0x9e37_79b9_7f4a_7c15);
        let mut z = self.0;
        z = (z ^ (z >> 30)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
        z = (z ^ (z >> 27)).wrapping_mul(0x94d0_49bb_1331_11eb);
        ((z ^ (z >> 31)) >> 11) as f64 / (1u64 << 53) as f64
    }

    fn between(&mut self, low: f64, high: f64) -> f64 {
        low + (high - low) * self.next()
    }
}

/// Slopes of at most 0.05 keep heights below 1 m, where f32 resolves 6e-8 m.
fn plane(x: f64, y: f64) -> f64 {
    0.1 + 0.05 * x - 0.03 * y
}

fn layer(geometry: &GridGeometry, surface: impl Fn(f64, f64) -> f64, mut hole: impl FnMut(f64, f64) -> bool) -> Vec<f32> {
    let points = (0..geometry.cells()).map(|i| geometry.to_world(i % geometry.width, i / geometry.width));
    points.map(|[x, y]| if hole(x, y) { f32::NAN } else { surface(x, y) as f32 }).collect()
}

fn map(geometry: GridGeometry, elevation_m: Vec<f32>) -> WorldMap {
    WorldMap::from_layers("holes", 1, geometry, elevation_m, None).unwrap()
}

fn patch_at(map: &WorldMap, x_m: f64, y_m: f64, yaw_rad: f64) -> Patch {
    let mut patch = Patch::new();
    sample_patch(map, Pose2 { x_m, y_m, yaw_rad }, &PatchScale::default(), &mut patch);
    patch
}

/// Random holes but in the corners of the map, where no known ground lies on the other side of a hole.
fn scattered(share: f64, seed: u64) -> impl FnMut(f64, f64) -> bool {
    let mut random = Random(seed);
    move |x, y| random.next() < share && !(x.abs() > 5.65 && y.abs() > 5.65)
}

/// Goal: small holes change nothing on a plane. Method: 5 and 30 % of the cells are holes, those of 30 % often side by side; heights, slopes and patches at
/// random places up to the border. What is left is f32: half of 6e-8 m on either end of 0.4 m, and the sums of slopes.
#[test]
fn analytic_a_plane_with_scattered_holes_is_the_plane() {
    for (share, seed) in [(0.05, 1), (0.3, 2), (0.3, 3)] {
        let holed = map(grid(), layer(&grid(), plane, scattered(share, seed)));
        let holes = holed.elevation_m().iter().filter(|z| z.is_nan()).count() as f64 / grid().cells() as f64;
        assert!((holes - share).abs() < 0.02, "{holes}");
        let mut random = Random(10 + seed);
        for _ in 0..20_000 {
            let (x, y) = (random.between(-6.0, 6.0), random.between(-6.0, 6.0));
            let ground = holed.ground(x, y).unwrap();
            assert!((ground.height_m - plane(x, y)).abs() < 1e-6, "{share}: {ground:?} at {x}, {y}");
            assert!((ground.slope_x - 0.05).abs() < 1e-6 && (ground.slope_y + 0.03).abs() < 1e-6, "{share}: {ground:?} at {x}, {y}");
        }
        let whole = map(grid(), layer(&grid(), plane, |_, _| false));
        let (seen, expected) = (patch_at(&holed, 0.3, -0.4, 0.7), patch_at(&whole, 0.3, -0.4, 0.7));
        assert_eq!(seen.known_share, expected.known_share, "no pixel is lost to a hole");
        assert!(seen.elevation.iter().zip(&expected.elevation).all(|(a, b)| (a - b).abs() < 1e-6));
    }
}

/// Goal: how far a filled height is off on curved ground. Method: waves of 3 m (0.2 m high from crest to trough, curvature up to 0.44 per m), the map with
/// holes against the map without. A single hole is a quarter of the Laplacian times the square of a cell off, 0.01 / 4 · 0.88 = 2.2 mm; two side by side more.
#[test]
fn analytic_a_curved_surface_is_met_within_millimetres() {
    let waves = |x: f64, y: f64| 0.1 * (2.1 * x).sin() * (2.1 * y).cos();
    let whole = map(grid(), layer(&grid(), waves, |_, _| false));
    for (share, root_m, worst_m) in [(0.05, 3e-4, 0.004), (0.3, 1.2e-3, 0.02)] {
        let holed = map(grid(), layer(&grid(), waves, scattered(share, 4)));
        let mut random = Random(5);
        let errors: Vec<f64> = (0..20_000)
            .map(|_| (random.between(-6.0, 6.0), random.between(-6.0, 6.0)))
            .map(|(x, y)| (holed.height_m(x, y).unwrap() - whole.height_m(x, y).unwrap()).abs())
            .collect();
        let root = (errors.iter().map(|e| e * e).sum::<f64>() / errors.len() as f64).sqrt();
        let worst = errors.iter().fold(0.0, |a: f64, b| a.max(*b));
        println!("{share}: {root} {worst}");
        assert!(root < root_m && worst < worst_m, "{share}: {root} m, at worst {worst} m");
    }
}

/// Goal: a hole of 2 m across is known to half a metre from its rim and unknown in its middle. Method: a round and a square one on a plane; the four cells
/// around a place must be known, so between 0.5 m less a diagonal of a cell and 0.5 m either is right.
#[test]
fn analytic_a_hole_of_two_metres_is_unknown_in_its_middle() {
    let round = |x: f64, y: f64| 1.0 - x.hypot(y);
    let square = |x: f64, y: f64| 1.0 - x.abs().max(y.abs());
    for inside_m in [round, square] {
        let holed = map(grid(), layer(&grid(), plane, |x, y| inside_m(x, y) > 1e-9));
        let mut random = Random(6);
        let mut counts = [0; 2];
        for _ in 0..20_000 {
            let (x, y) = (random.between(-1.5, 1.5), random.between(-1.5, 1.5));
            let ground = holed.ground(x, y);
            if inside_m(x, y) < BELIEVED_M - 0.15 {
                counts[0] += 1;
                let ground = ground.unwrap();
                assert!((ground.height_m - plane(x, y)).abs() < 1e-6, "{ground:?} at {x}, {y}");
                assert!((ground.slope_x - 0.05).abs() < 1e-6 && (ground.slope_y + 0.03).abs() < 1e-6, "{ground:?} at {x}, {y}");
            } else if inside_m(x, y) > BELIEVED_M + 0.1 {
                counts[1] += 1;
                assert!(ground.is_none() && holed.height_m(x, y).is_none(), "{ground:?} at {x}, {y}");
                assert!((holed.nearest_height_m(x, y) - plane(x, y)).abs() < 0.05, "a height is there all the same");
            }
        }
        assert!(counts[0] > 10_000 && counts[1] > 300, "{counts:?}");
        // The unknown square of the square hole is 0.8 m wide: its cells are 9 by 9, and what is next to them counts too.
        let share = patch_at(&holed, 0.0, 0.0, 0.0).known_share;
        let whole = patch_at(&map(grid(), layer(&grid(), plane, |_, _| false)), 0.0, 0.0, 0.0).known_share;
        assert!((60.0..=100.0).contains(&f64::from((whole - share) * 128.0 * 128.0).round()), "{share} {whole}");
    }
}

/// Goal: a hole at the border is filled from the sides that there are, and what lies beyond the border stays off the map. Method: on a plane, a hole of 0.9 m
/// by 2 m at the western border has known ground in the north and the south; a corner has it on two neighbouring sides only and goes on level.
#[test]
fn analytic_a_hole_at_the_border() {
    let holed = map(grid(), layer(&grid(), plane, |x, y| (x < -5.15 && y.abs() < 0.95) || (x > 5.55 && y > 5.55)));
    for (x, y) in [(-6.0, 0.8), (-5.2, 0.0), (-5.55, -0.1), (-5.9, -0.6)] {
        let ground = holed.ground(x, y).unwrap();
        assert!((ground.height_m - plane(x, y)).abs() < 1e-6 && (ground.slope_x - 0.05).abs() < 1e-6, "{ground:?} at {x}, {y}");
    }
    assert!(holed.ground(-6.0, 0.0).is_none(), "0.9 m from known ground on every side");
    let corner = holed.ground(5.9, 5.9).unwrap();
    assert!((corner.height_m - plane(5.9, 5.9)).abs() < 0.05 * 0.4 + 0.03 * 0.4, "{corner:?}: within the relief of the hole");
    for (x, y) in [(-6.05, 0.8), (6.05, 5.9), (0.0, -6.05)] {
        assert!(holed.ground(x, y).is_none() && holed.height_m(x, y).is_none(), "beyond the border");
    }
}

/// Goal: a map of holes alone is refused, and where one cell is known, half a metre around it is. Method: the cell (0, 0) of World, everything else a hole.
#[test]
fn analytic_one_known_cell_in_a_map_of_holes() {
    let refused = WorldMap::from_layers("none", 1, grid(), vec![f32::NAN; SIDE * SIDE], None).unwrap_err();
    assert!(refused.to_string().contains("no cell is known"), "{refused}");
    let holed = map(grid(), layer(&grid(), |_, _| 0.25, |x, y| x.hypot(y) > 0.01));
    for [x, y] in (0..SIDE * SIDE).map(|i| grid().to_world(i % SIDE, i / SIDE)) {
        let (away, ground) = (x.hypot(y), holed.ground(x, y));
        if away < BELIEVED_M - 0.15 {
            assert_eq!(ground.map(|g| (g.height_m, g.slope_x, g.slope_y)), Some((0.25, 0.0, 0.0)), "{x}, {y}");
        } else if away > BELIEVED_M + 0.01 {
            assert_eq!(ground, None, "{x}, {y}");
        }
        assert_eq!(holed.nearest_height_m(x, y), 0.25);
    }
    let coarse = GridGeometry { resolution_m: 1.0, ..grid() };
    let mut elevation_m = vec![0.25; SIDE * SIDE];
    elevation_m[5 * SIDE + 7] = f32::NAN;
    assert!(map(coarse, elevation_m).ground(1.5, -0.5).is_none(), "a cell of 1 m is further away than half a metre");
}

/// Goal: what counts as known is what lies within half a metre of a given cell, and nothing else. Method: every square of four cells of maps with few known
/// cells against all distances, at resolutions that divide half a metre and that do not, and one that was rounded to f32.
#[test]
fn property_known_is_within_half_a_metre() {
    for (resolution_m, share, seed) in
        [(0.1, 0.97, 20), (0.1f32.into(), 0.97, 21), (0.07, 0.99, 22), (0.25, 0.8, 23), (0.5, 0.6, 24), (0.6, 0.5, 25)]
    {
        let geometry = GridGeometry { origin_m: [3.0, -8.0], resolution_m, width: 60, height: 47 };
        let mut random = Random(seed);
        let elevation_m = layer(&geometry, |x, y| 0.1 * x + 0.05 * y, |_, _| random.next() < share);
        let given: Vec<[usize; 2]> = (0..elevation_m.len()).filter(|i| !elevation_m[*i].is_nan()).map(|i| [i % 60, i / 60]).collect();
        let holed = map(geometry, elevation_m);
        let near = |column: usize, row: usize| {
            given.iter().any(|[c, r]| (*c as f64 - column as f64).hypot(*r as f64 - row as f64) * resolution_m <= BELIEVED_M + 1e-6)
        };
        let mut counts = [0; 2];
        for (column, row) in (0..59 * 46).map(|i| (i % 59, i / 59)) {
            let [x, y] = geometry.to_world(column, row).map(|v| v + 0.4 * resolution_m);
            let known = [(0, 0), (1, 0), (0, 1), (1, 1)].iter().all(|(east, north)| near(column + east, row + north));
            assert_eq!(holed.ground(x, y).is_some(), known, "column {column}, row {row} of {resolution_m} m");
            counts[usize::from(known)] += 1;
        }
        assert!(counts.iter().all(|n| *n > 50), "{counts:?} at {resolution_m} m");
    }
}

/// Goal: filling makes up no height that is not around, leaves what is given, sees no direction and gives the same twice. Method: rough ground with steps of
/// 1 m, holes single and large, against its mirror image.
#[test]
fn property_filled_heights_lie_between_given_ones() {
    let rough = |x: f64, y: f64| (if x + 0.5 * y > 0.0 { 1.0 } else { 0.0 }) + 0.05 * (9.0 * x).sin() * (7.0 * y).cos();
    for seed in 30..33 {
        let mut random = Random(seed);
        let large: Vec<[f64; 3]> =
            (0..8).map(|_| [random.between(-6.0, 6.0), random.between(-6.0, 6.0), random.between(0.3, 2.5)]).collect();
        let hole = |x: f64, y: f64| random.next() < 0.2 || large.iter().any(|[cx, cy, r]| (x - cx).hypot(y - cy) < *r);
        let elevation_m = layer(&grid(), rough, hole);
        let holed = map(grid(), elevation_m.clone());
        let (twice, mirrored) = (map(grid(), elevation_m.clone()), holed.mirrored());
        let given = elevation_m.iter().filter(|z| !z.is_nan());
        let (low, high) = given.fold((f32::MAX, f32::MIN), |(low, high), z| (low.min(*z), high.max(*z)));
        for (i, given) in elevation_m.iter().enumerate() {
            let [x, y] = grid().to_world(i % SIDE, i / SIDE);
            let z = holed.nearest_height_m(x, y);
            assert!((f64::from(low) - 1e-6..=f64::from(high) + 1e-6).contains(&z), "{z} at {x}, {y}");
            assert!(given.is_nan() || (f64::from(*given) - z).abs() < 1e-6);
            assert_eq!(holed.cell_elevation_m(i).to_bits(), given.to_bits(), "given back as it was");
            assert_eq!((z, holed.ground(x, y)), (twice.nearest_height_m(x, y), twice.ground(x, y)));
            assert!((z - mirrored.nearest_height_m(x, -y)).abs() < 1e-6, "{x}, {y}");
        }
        assert_eq!(mirrored.mirrored().hash(), holed.hash());
    }
}

/// Goal: a patched map is the map that would have been uploaded so. Method: tiles with holes inside, along and across their borders, one after the other on a
/// map with holes; heights, slopes, what is known and what the encoders see, bit for bit.
#[test]
fn property_a_patched_map_is_the_map_built_anew() {
    let surface = |x: f64, y: f64| 0.2 * (0.9 * x).sin() + 0.1 * (1.3 * y).cos();
    let mut elevation_m = layer(&grid(), surface, |x, y| (x - 1.0).hypot(y) < 0.8 || x < -5.0);
    let mut patched = map(grid(), elevation_m.clone());
    let mut random = Random(40);
    let mut unknown = 0;
    for turn in 0..12 {
        let [width, height] = [random.between(1.0, 40.0) as usize, random.between(1.0, 40.0) as usize];
        let [column0, row0] = [width, height].map(|side| (random.next() * (SIDE - side + 1) as f64) as usize);
        // Scattered holes, a frame of holes along the border of the tile, its southern half, or none: the tile closes holes too.
        let hole = |column: usize, row: usize, chance: f64| match turn % 4 {
            0 => chance < 0.3,
            1 => column < 3 || row < 3 || column + 3 >= width || row + 3 >= height,
            2 => row < height / 2,
            _ => false,
        };
        let tile: Vec<f32> = (0..width * height)
            .map(|i| (i % width, i / width, random.next()))
            .map(|(column, row, chance)| if hole(column, row, chance) { f32::NAN } else { 0.3 + 0.01 * column as f32 - 0.02 * row as f32 })
            .collect();
        for (i, z) in tile.iter().enumerate() {
            elevation_m[(row0 + i / width) * SIDE + column0 + i % width] = *z;
        }
        patched = patched.with_tile(column0, row0, width, height, &tile, None).unwrap();
        let anew = map(grid(), elevation_m.clone());
        assert_eq!(patched.hash(), anew.hash());
        for i in 0..SIDE * SIDE {
            let [x, y] = grid().to_world(i % SIDE, i / SIDE).map(|v| v + 0.03);
            assert_eq!(patched.ground(x, y), anew.ground(x, y), "turn {turn}, {x}, {y}");
            assert_eq!(patched.nearest_height_m(x, y), anew.nearest_height_m(x, y));
            assert_eq!(patched.cell_elevation_m(i).to_bits(), anew.cell_elevation_m(i).to_bits());
            unknown += usize::from(patched.contains(x, y) && patched.ground(x, y).is_none());
        }
        assert_eq!(patch_at(&patched, 0.5, -1.0, 0.4), patch_at(&anew, 0.5, -1.0, 0.4));
    }
    assert!(unknown > 1000, "{unknown}: some places must be unknown");
}

/// Prints what holes cost where a map is made, 4 million cells: none, single ones, and a disc of known ground in a map of holes.
#[test]
fn regress_cost_of_holes_is_printed() {
    let side = 2048;
    let geometry = GridGeometry { origin_m: [0.0, 0.0], resolution_m: 0.1, width: side, height: side };
    let mut random = Random(50);
    let disc = |i: usize| (i as f64 % side as f64 - 1024.0).hypot(i as f64 / side as f64 - 1024.0) > 700.0;
    for (name, share) in [("none", 0.0), ("5 %", 0.05), ("30 %", 0.3), ("a disc of known ground", 2.0)] {
        let hole = |i: usize| if share > 1.0 { disc(i) } else { random.next() < share };
        let elevation_m: Vec<f32> =
            (0..side * side).map(hole).enumerate().map(|(i, hole)| if hole { f32::NAN } else { i as f32 * 1e-6 }).collect();
        let start = std::time::Instant::now();
        let holed = map(geometry, elevation_m);
        println!("a map of 4 million cells, holes: {name}: {} ms", start.elapsed().as_millis());
        assert!(holed.ground(102.4, 102.4).is_some());
    }
}
