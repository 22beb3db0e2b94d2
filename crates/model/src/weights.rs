//! Named weights: plain f32 arrays with their shapes, as they lie in a safetensors file.

use std::collections::BTreeMap;
use std::path::Path;
use std::sync::Arc;

use safetensors::tensor::TensorView;
use safetensors::{Dtype, SafeTensors};

use crate::ModelError;

/// One named array, row-major.
#[derive(Clone, Debug, PartialEq)]
pub struct Array {
    /// Shape.
    pub shape: Vec<usize>,
    /// Values.
    pub values: Vec<f32>,
}

/// A set of named arrays, ordered by name so that files are reproducible byte for byte. Clones share them until one is changed.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Weights {
    arrays: Arc<BTreeMap<String, Array>>,
}

impl Weights {
    /// Adds or replaces an array. The number of values must match the shape.
    pub fn insert(&mut self, name: impl Into<String>, shape: &[usize], values: Vec<f32>) {
        assert_eq!(shape.iter().product::<usize>(), values.len(), "shape and values disagree; this is a bug");
        Arc::make_mut(&mut self.arrays).insert(name.into(), Array { shape: shape.to_vec(), values });
    }

    /// All arrays in the order of their names.
    pub fn iter(&self) -> impl Iterator<Item = (&str, &Array)> {
        self.arrays.iter().map(|(name, array)| (name.as_str(), array))
    }

    /// Values of an array, to be changed in place.
    pub fn values_mut(&mut self, name: &str) -> Option<&mut [f32]> {
        Arc::make_mut(&mut self.arrays).get_mut(name).map(|array| array.values.as_mut_slice())
    }

    /// Number of values whose name starts with `prefix`.
    pub fn parameters(&self, prefix: &str) -> usize {
        self.iter().filter(|(name, _)| name.starts_with(prefix)).map(|(_, a)| a.values.len()).sum()
    }

    /// An array of the expected shape.
    ///
    /// # Errors
    /// `ModelError::Weights` naming the array when it is absent or has another shape.
    pub fn get(&self, name: &str, shape: &[usize]) -> Result<&[f32], ModelError> {
        let array = self.arrays.get(name).ok_or_else(|| ModelError::Weights { name: name.into(), reason: "is missing".into() })?;
        if array.shape != shape {
            let reason = format!("has shape {:?}, expected {shape:?}", array.shape);
            return Err(ModelError::Weights { name: name.into(), reason });
        }
        Ok(&array.values)
    }

    /// Serialises to safetensors bytes.
    pub fn to_bytes(&self) -> Vec<u8> {
        let raw: Vec<(String, Vec<usize>, Vec<u8>)> = self
            .iter()
            .map(|(name, a)| (name.to_string(), a.shape.clone(), a.values.iter().flat_map(|v| v.to_le_bytes()).collect()))
            .collect();
        let views = raw.iter().map(|(name, shape, bytes)| {
            let view = TensorView::new(Dtype::F32, shape.clone(), bytes).expect("shape matches bytes; this is a bug");
            (name.as_str(), view)
        });
        safetensors::serialize(views, None).expect("serialising f32 arrays cannot fail; this is a bug")
    }

    /// Reads safetensors bytes; `path` is only named in errors.
    ///
    /// # Errors
    /// `ModelError::Bundle` when the bytes are no safetensors file, hold another type than f32, or a number is not finite.
    pub fn from_bytes(bytes: &[u8], path: &Path) -> Result<Self, ModelError> {
        let fail = |reason: String| ModelError::Bundle { path: path.to_path_buf(), reason };
        let file = SafeTensors::deserialize(bytes).map_err(|e| fail(format!("is no readable safetensors file: {e}")))?;
        let mut weights = Self::default();
        for (name, view) in file.tensors() {
            if view.dtype() != Dtype::F32 {
                return Err(fail(format!("array `{name}` has type {:?}, expected F32", view.dtype())));
            }
            let values: Vec<f32> = view.data().chunks_exact(4).map(|b| f32::from_le_bytes([b[0], b[1], b[2], b[3]])).collect();
            if let Some(at) = values.iter().position(|v| !v.is_finite()) {
                return Err(fail(format!("array `{name}` holds a number that is not finite at index {at}")));
            }
            weights.insert(name, view.shape(), values);
        }
        Ok(weights)
    }
}
