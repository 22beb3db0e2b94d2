//! Reading a world folder: world.json, elevation.png, semantic.png.

use std::path::{Path, PathBuf};

use nesam_physics::SOIL_DIM;
use serde_json::Value;

use crate::error::TerrainError;
use crate::geometry::GridGeometry;
use crate::image::{GRAY_16, RGB_8, read_image};
use crate::world_map::{SoilClassRange, WorldMap};

/// Names of the soil parameters in the files of a world, in the order of the soil vector.
pub const SOIL_KEYS: [&str; SOIL_DIM] = ["Kphi", "Kc", "n", "c", "phi", "K"];

/// Name of the elevation image where `world.json` gives none.
const ELEVATION: &str = "elevation.png";

/// Index of the friction angle in the soil vector: files give it in degrees.
const PHI: usize = 4;

impl WorldMap {
    /// Reads a world folder: `world.json`, the 16-bit elevation image and, where there is one, the RGB semantic image.
    ///
    /// Height is `offset_m + scale_m * pixel`. Image row 0 is the north row; the map is stored south first. The id is that of the
    /// folder, the version is 1.
    ///
    /// # Errors
    /// `TerrainError` naming the file and what was wrong: the key of world.json, or the row of a damaged or truncated image.
    pub fn load(world_dir: &Path) -> Result<Self, TerrainError> {
        let json = WorldJson::read(&world_dir.join("world.json"))?;
        let geometry = json.geometry()?;
        let (width, height) = (geometry.width, geometry.height);

        let scale_m = json.number("elevation.scale_m")?;
        let offset_m = json.number("elevation.offset_m")?;
        if scale_m == 0.0 || scale_m.abs() > 1.0 || offset_m.abs() > 1e4 {
            let reason = format!("scale {scale_m} m and offset {offset_m} m do not give heights within 10 km");
            return Err(json.wrong("elevation.scale_m", reason));
        }
        let elevation_png = world_dir.join(json.file("elevation.file", ELEVATION)?);
        let gray = read_image(&elevation_png, GRAY_16, width, height)?;
        let to_height = |b: &[u8]| (offset_m + scale_m * f64::from(u16::from_be_bytes([b[0], b[1]]))) as f32;
        let elevation_m: Vec<f32> = gray.chunks_exact(2).map(to_height).collect();

        // A world without semantics is valid: either key or image may be missing.
        let semantic_png = world_dir.join(json.file("semantic.file", "semantic.png")?);
        let semantic_rgb = if semantic_png.exists() {
            let rgb = read_image(&semantic_png, RGB_8, width, height)?;
            Some(rgb.chunks_exact(3).map(|c| [c[0], c[1], c[2]]).collect())
        } else {
            None
        };
        let id = world_dir.file_name().map(|n| n.to_string_lossy().into_owned()).unwrap_or_default();
        let map = Self::from_layers(&id, 1, geometry, elevation_m, semantic_rgb)?;
        Ok(map.with_soil_classes(json.soil_classes()?))
    }

    /// Whether a world folder has its elevation image: the one that `world.json` names, else `elevation.png`. Without it there is no map to load.
    pub fn has_elevation(world_dir: &Path) -> bool {
        let named = WorldJson::read(&world_dir.join("world.json")).and_then(|json| json.file("elevation.file", ELEVATION));
        world_dir.join(named.unwrap_or_else(|_| ELEVATION.into())).is_file()
    }
}

/// world.json with its path, so that every error can name both.
struct WorldJson {
    path: PathBuf,
    root: Value,
}

impl WorldJson {
    fn read(path: &Path) -> Result<Self, TerrainError> {
        let text = std::fs::read(path).map_err(|source| TerrainError::Read { path: path.to_path_buf(), source })?;
        let root = serde_json::from_slice(&text).map_err(|source| TerrainError::Json { path: path.to_path_buf(), source })?;
        Ok(Self { path: path.to_path_buf(), root })
    }

    fn wrong(&self, key: &str, reason: impl Into<String>) -> TerrainError {
        TerrainError::Key { path: self.path.clone(), key: key.into(), reason: reason.into() }
    }

    fn get(&self, dotted: &str) -> Option<&Value> {
        dotted.split('.').try_fold(&self.root, |value, key| value.get(key)).filter(|v| !v.is_null())
    }

    fn required(&self, key: &str) -> Result<&Value, TerrainError> {
        self.get(key).ok_or_else(|| self.wrong(key, "missing"))
    }

    fn finite(&self, key: &str, value: &Value) -> Result<f64, TerrainError> {
        let number = value.as_f64().filter(|x| x.is_finite());
        number.ok_or_else(|| self.wrong(key, format!("expected a finite number, found {value}")))
    }

    fn number(&self, key: &str) -> Result<f64, TerrainError> {
        self.finite(key, self.required(key)?)
    }

    fn count(&self, key: &str) -> Result<usize, TerrainError> {
        let value = self.required(key)?;
        let count = value.as_u64().and_then(|n| usize::try_from(n).ok());
        count.ok_or_else(|| self.wrong(key, format!("expected a positive integer, found {value}")))
    }

    /// A file name inside the world folder.
    fn file(&self, key: &str, default: &str) -> Result<String, TerrainError> {
        let Some(value) = self.get(key) else {
            return Ok(default.into());
        };
        let plain = |s: &&str| !s.is_empty() && !s.contains(['/', '\\']) && !s.starts_with("..");
        let name = value.as_str().filter(plain);
        name.map(String::from).ok_or_else(|| self.wrong(key, format!("expected a plain file name, found {value}")))
    }

    fn geometry(&self) -> Result<GridGeometry, TerrainError> {
        let origin = self.required("origin_m")?;
        let [x, y] = self.pair("origin_m", origin)?;
        let geometry = GridGeometry {
            origin_m: [x, y],
            resolution_m: self.number("resolution_m")?,
            width: self.count("width_px")?,
            height: self.count("height_px")?,
        };
        geometry.check().map_err(|(field, reason)| {
            let key = match field {
                "width" => "width_px",
                "height" => "height_px",
                other => other,
            };
            self.wrong(key, reason)
        })?;
        Ok(geometry)
    }

    fn pair(&self, key: &str, value: &Value) -> Result<[f64; 2], TerrainError> {
        match value.as_array().map(Vec::as_slice) {
            Some([a, b]) => Ok([self.finite(key, a)?, self.finite(key, b)?]),
            _ => Err(self.wrong(key, format!("expected two numbers, found {value}"))),
        }
    }

    /// The classes in the order of `classes`, else in the order of the file.
    fn soil_classes(&self) -> Result<Vec<SoilClassRange>, TerrainError> {
        let Some(ranges) = self.get("soil_prior_ranges") else {
            return Ok(Vec::new());
        };
        let ranges = ranges.as_object().ok_or_else(|| self.wrong("soil_prior_ranges", "expected an object of classes"))?;
        let listed: Vec<String> = match self.get("classes").and_then(Value::as_array) {
            Some(names) => names.iter().filter_map(|n| n.as_str().map(String::from)).collect(),
            None => ranges.keys().cloned().collect(),
        };
        listed.into_iter().filter(|name| ranges.contains_key(name)).map(|name| self.soil_class(name)).collect()
    }

    fn soil_class(&self, name: String) -> Result<SoilClassRange, TerrainError> {
        let (mut low, mut high) = ([0.0; SOIL_DIM], [0.0; SOIL_DIM]);
        for (i, parameter) in SOIL_KEYS.iter().enumerate() {
            let key = format!("soil_prior_ranges.{name}.{parameter}");
            let [a, b] = self.pair(&key, self.required(&key)?)?;
            if !(a > 0.0 && a <= b) {
                return Err(self.wrong(&key, format!("[{a}, {b}] is not a positive ascending range")));
            }
            let unit = if i == PHI { std::f64::consts::PI / 180.0 } else { 1.0 };
            (low[i], high[i]) = (a * unit, b * unit);
        }
        let key = format!("semantic.palette.{name}");
        let colour = self.get(&key).map(|value| self.colour(&key, value)).transpose()?;
        Ok(SoilClassRange { name, colour, low, high })
    }

    fn colour(&self, key: &str, value: &Value) -> Result<[u8; 3], TerrainError> {
        let wrong = || self.wrong(key, format!("expected three integers 0..=255, found {value}"));
        let parts = value.as_array().ok_or_else(wrong)?;
        let bytes: Option<Vec<u8>> = parts.iter().map(|p| p.as_u64().and_then(|n| u8::try_from(n).ok())).collect();
        bytes.and_then(|b| <[u8; 3]>::try_from(b).ok()).ok_or_else(wrong)
    }
}
