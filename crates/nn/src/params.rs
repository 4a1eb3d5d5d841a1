//! Named parameters of a model: created from our own generator, iterated in the order of their names.

use crate::backend::Backend;
use crate::error::{ModelError, Result, some_names};
use crate::rng::Rng;
use candle_core::{DType, Device, Tensor, Var};
use std::collections::BTreeMap;
use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};

/// How a new parameter is filled. Fans are those of a `(out, in)` matrix.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Init {
    /// all 0
    Zeros,
    /// all 1
    Ones,
    /// normal with mean 0
    Normal {
        /// standard deviation
        std: f64,
    },
    /// normal with mean 0, drawn again beyond two standard deviations
    TruncatedNormal {
        /// standard deviation before truncation
        std: f64,
    },
    /// uniform in ±`bound`
    Uniform {
        /// largest magnitude
        bound: f64,
    },
    /// uniform in ±sqrt(6 / (fan_in + fan_out))
    XavierUniform,
    /// uniform in ±1 / sqrt(fan_in): `torch.nn.Linear`'s default weight
    KaimingUniform,
}

impl Init {
    /// Values of a parameter of this shape.
    pub fn values(self, shape: &[usize], rng: &mut Rng) -> Vec<f32> {
        let n: usize = shape.iter().product();
        let (fan_out, fan_in) = match *shape {
            [out, input] => (out as f64, input as f64),
            [len] => (len as f64, len as f64),
            _ => {
                let per = shape.iter().skip(2).product::<usize>();
                let at = |i: usize| shape.get(i).copied().unwrap_or(1) * per;
                (at(0) as f64, at(1) as f64)
            }
        };
        let mut uniform = |bound: f64| -> Vec<f32> {
            (0..n).map(|_| ((2.0 * f64::from(rng.uniform()) - 1.0) * bound) as f32).collect()
        };
        match self {
            Self::Zeros => vec![0.0; n],
            Self::Ones => vec![1.0; n],
            Self::Uniform { bound } => uniform(bound),
            Self::XavierUniform => uniform((6.0 / (fan_in + fan_out)).sqrt()),
            Self::KaimingUniform => uniform(1.0 / fan_in.sqrt()),
            Self::Normal { std } => (0..n).map(|_| rng.normal_f32() * std as f32).collect(),
            Self::TruncatedNormal { std } => (0..n)
                .map(|_| {
                    loop {
                        let x = rng.normal_f32();
                        if x.abs() <= 2.0 {
                            break x * std as f32;
                        }
                    }
                })
                .collect(),
        }
    }
}

/// Rows of one width, as many as the demonstrations bring.
#[derive(Debug)]
struct Table {
    columns: usize,
    /// (rows, columns), once there are some
    rows: Option<Tensor>,
}

/// A model's parameters by name, its buffers, numbers that belong to the weights and are never trained, and its tables,
/// rows kept of the demonstrations themselves: all on one device. Cloning shares the storage.
#[derive(Debug, Clone)]
pub struct Params {
    backend: Backend,
    vars: BTreeMap<String, Var>,
    buffers: BTreeMap<String, Var>,
    tables: Arc<Mutex<BTreeMap<String, Table>>>,
    /// learning rates relative to the others'
    rates: BTreeMap<String, f64>,
    version: Arc<AtomicU64>,
}

impl Params {
    /// No parameters yet; they will be on the backend's device.
    pub fn new(backend: &Backend) -> Self {
        Self {
            backend: backend.clone(),
            vars: BTreeMap::new(),
            buffers: BTreeMap::new(),
            tables: Arc::default(),
            rates: BTreeMap::new(),
            version: Arc::default(),
        }
    }

    /// Creates `name` and returns its tensor, which shares the storage: later updates are seen through it.
    ///
    /// # Errors
    /// If the name is taken, or the tensor library fails.
    pub fn create(&mut self, name: &str, shape: &[usize], init: Init, rng: &mut Rng) -> Result<Tensor> {
        self.insert(name, Tensor::from_vec(init.values(shape, rng), shape, self.device())?)
    }

    /// Adds `name` with the given values.
    ///
    /// # Errors
    /// If the name is taken.
    pub fn insert(&mut self, name: &str, values: Tensor) -> Result<Tensor> {
        let var = self.new_var(name, &values)?;
        let tensor = var.as_tensor().clone();
        self.vars.insert(name.to_string(), var);
        Ok(tensor)
    }

    /// Adds `name` with values that are saved and loaded like parameters and never trained.
    ///
    /// # Errors
    /// If the name is taken.
    pub fn insert_buffer(&mut self, name: &str, values: Tensor) -> Result<Tensor> {
        let var = self.new_var(name, &values)?;
        let tensor = var.as_tensor().clone();
        self.buffers.insert(name.to_string(), var);
        Ok(tensor)
    }

    fn new_var(&self, name: &str, values: &Tensor) -> Result<Var> {
        self.check_new(name)?;
        Ok(Var::from_tensor(&values.to_device(self.device())?.contiguous()?)?)
    }

    fn check_new(&self, name: &str) -> Result<()> {
        if self.vars.contains_key(name) || self.buffers.contains_key(name) || self.lock().contains_key(name) {
            return Err(ModelError::State { object: "parameters", detail: format!("{name} exists already") });
        }
        Ok(())
    }

    fn lock(&self) -> MutexGuard<'_, BTreeMap<String, Table>> {
        self.tables.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Adds a table `name` of rows of `columns` numbers, which are saved and loaded like parameters; there are none yet.
    ///
    /// # Errors
    /// If the name is taken.
    pub fn insert_table(&mut self, name: &str, columns: usize) -> Result<()> {
        self.check_new(name)?;
        self.lock().insert(name.to_string(), Table { columns, rows: None });
        Ok(())
    }

    /// Fills a table. rows: (rows, columns)
    ///
    /// # Errors
    /// If there is no such table, or its rows have another width.
    pub fn set_table(&self, name: &str, rows: &Tensor) -> Result<()> {
        let mut tables = self.lock();
        let given = some_names(tables.keys());
        let table = tables.get_mut(name).ok_or_else(|| ModelError::MissingTensor { name: name.to_string(), given })?;
        table.check(name, rows)?;
        table.rows = Some(self.placed(rows)?);
        drop(tables);
        self.changed();
        Ok(())
    }

    /// The rows of a table: (rows, columns)
    ///
    /// # Errors
    /// If there is no such table, or nothing was put into it.
    pub fn table(&self, name: &str) -> Result<Tensor> {
        let tables = self.lock();
        let rows = tables.get(name).and_then(|table| table.rows.clone());
        rows.ok_or_else(|| ModelError::MissingTensor { name: name.to_string(), given: some_names(tables.keys()) })
    }

    /// The tables that have rows, in the order of their names.
    pub fn tables(&self) -> Vec<(String, Tensor)> {
        self.lock().iter().filter_map(|(name, table)| Some((name.clone(), table.rows.clone()?))).collect()
    }

    /// Names of parameters and buffers, each in order.
    pub fn names(&self) -> impl Iterator<Item = &str> {
        self.vars.keys().chain(self.buffers.keys()).map(String::as_str)
    }

    /// Buffers in the order of their names.
    pub fn buffers(&self) -> impl Iterator<Item = (&str, &Var)> {
        self.buffers.iter().map(|(k, v)| (k.as_str(), v))
    }

    /// Sets the values of a buffer.
    ///
    /// # Errors
    /// If there is no such buffer, or it has another shape.
    pub fn set_buffer(&self, name: &str, values: &Tensor) -> Result<()> {
        let Some(buffer) = self.buffers.get(name) else {
            let given = some_names(self.buffers.keys());
            return Err(ModelError::MissingTensor { name: name.to_string(), given });
        };
        if values.dims() != buffer.dims() {
            let (name, expected, found) = (name.to_string(), buffer.dims().to_vec(), values.dims().to_vec());
            return Err(ModelError::MisshapenTensor { name, expected, found });
        }
        buffer.set(&self.placed(values)?)?;
        self.changed();
        Ok(())
    }

    /// Everything that is saved: parameters, then buffers.
    pub fn all(&self) -> impl Iterator<Item = (&str, &Var)> {
        self.iter().chain(self.buffers())
    }

    /// Names and variables in order. After setting a value say so with [`Self::changed`].
    pub fn iter(&self) -> impl Iterator<Item = (&str, &Var)> {
        self.vars.iter().map(|(k, v)| (k.as_str(), v))
    }

    /// Learning rate of every parameter whose name begins with `prefix`, relative to the others'.
    pub fn set_rate(&mut self, prefix: &str, rate: f64) {
        let names = self.vars.keys().filter(|name| name.starts_with(prefix));
        self.rates.extend(names.map(|name| (name.clone(), rate)));
    }

    /// Learning rate of a parameter relative to the others': 1 unless set.
    pub fn rate(&self, name: &str) -> f64 {
        self.rates.get(name).copied().unwrap_or(1.0)
    }

    /// One variable. After setting its value say so with [`Self::changed`].
    pub fn get(&self, name: &str) -> Option<&Var> {
        self.vars.get(name)
    }

    /// How often values were changed: what is derived from them is stale once it is another number.
    pub fn version(&self) -> u64 {
        self.version.load(Ordering::Acquire)
    }

    /// Says that values were changed. `load` and the optimisers do so themselves.
    pub fn changed(&self) {
        self.version.fetch_add(1, Ordering::AcqRel);
    }

    /// The same parameters but some; storage is shared.
    pub fn without(&self, names: &[&str]) -> Self {
        let kept = self.vars.iter().filter(|(name, _)| !names.contains(&name.as_str()));
        let vars = kept.map(|(name, var)| (name.clone(), var.clone())).collect();
        Self { vars, ..self.clone() }
    }

    /// Where they are, and which operations run on them.
    pub fn backend(&self) -> &Backend {
        &self.backend
    }

    /// Where they are.
    pub fn device(&self) -> &Device {
        self.backend.device()
    }

    /// Given values as those of parameters are.
    fn placed(&self, values: &Tensor) -> Result<Tensor> {
        Ok(values.to_device(self.device())?.to_dtype(DType::F32)?.contiguous()?)
    }

    /// Number of scalar parameters, without buffers.
    pub fn count(&self) -> usize {
        self.vars.values().map(|v| v.elem_count()).sum()
    }

    /// The current values of everything, sharing the storage: copy them before the next update if they must stay.
    pub fn tensors(&self) -> BTreeMap<String, Tensor> {
        self.all().map(|(k, v)| (k.to_string(), v.as_detached_tensor())).chain(self.tables()).collect()
    }

    /// Takes all values from `tensors`, whose names and shapes must be exactly those of the model.
    /// Nothing is changed unless everything fits.
    ///
    /// # Errors
    /// The first name that is missing, extra or misshapen.
    pub fn load(&self, tensors: &BTreeMap<String, Tensor>) -> Result<()> {
        for (name, var) in self.all() {
            let given = tensors.get(name).ok_or_else(|| ModelError::MissingTensor {
                name: name.to_string(),
                given: some_names(tensors.keys()),
            })?;
            if given.dims() != var.dims() {
                return Err(ModelError::MisshapenTensor {
                    name: name.to_string(),
                    expected: var.dims().to_vec(),
                    found: given.dims().to_vec(),
                });
            }
        }
        let mut tables = self.lock();
        let known = |k: &String| self.vars.contains_key(k) || self.buffers.contains_key(k) || tables.contains_key(k);
        if let Some(name) = tensors.keys().find(|k| !known(k)) {
            let known = some_names(self.vars.keys().chain(self.buffers.keys()).chain(tables.keys()));
            return Err(ModelError::ExtraTensor { name: name.clone(), known });
        }
        for (name, table) in &*tables {
            let given = tensors
                .get(name)
                .ok_or_else(|| ModelError::MissingTensor { name: name.clone(), given: some_names(tensors.keys()) })?;
            table.check(name, given)?;
        }
        for (name, var) in self.all() {
            // copied, because a variable cannot be set to itself
            var.set(&self.placed(&tensors[name])?.copy()?)?;
        }
        for (name, table) in &mut *tables {
            table.rows = Some(self.placed(&tensors[name])?);
        }
        drop(tables);
        self.changed();
        Ok(())
    }
}

impl Table {
    fn check(&self, name: &str, rows: &Tensor) -> Result<()> {
        match *rows.dims() {
            [count, columns] if count > 0 && columns == self.columns => Ok(()),
            _ => Err(ModelError::MisshapenTensor {
                name: name.to_string(),
                expected: vec![rows.dims().first().copied().unwrap_or(1).max(1), self.columns],
                found: rows.dims().to_vec(),
            }),
        }
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use super::*;

    fn two() -> Params {
        let mut rng = Rng::new(0, "init");
        let mut params = Params::new(&Backend::CPU);
        params.create("b", &[3], Init::Ones, &mut rng).unwrap();
        params.create("a", &[2, 3], Init::XavierUniform, &mut rng).unwrap();
        params
    }

    #[test]
    fn load_names_what_does_not_fit() {
        let params = two();
        let good = two().tensors();
        params.load(&good).unwrap();
        let mut missing = good.clone();
        missing.remove("b");
        assert!(matches!(params.load(&missing), Err(ModelError::MissingTensor { name, .. }) if name == "b"));
        let mut extra = good.clone();
        extra.insert("c".into(), good["b"].clone());
        assert!(matches!(params.load(&extra), Err(ModelError::ExtraTensor { name, .. }) if name == "c"));
        let mut bent = good.clone();
        bent.insert("a".into(), good["a"].t().unwrap());
        assert!(matches!(params.load(&bent), Err(ModelError::MisshapenTensor { name, .. }) if name == "a"));
    }

    #[test]
    fn names_come_sorted_and_once() {
        let mut params = two();
        assert_eq!(params.names().collect::<Vec<_>>(), ["a", "b"]);
        assert_eq!(params.count(), 9);
        let mut rng = Rng::new(0, "init");
        assert!(params.create("a", &[1], Init::Zeros, &mut rng).is_err());
    }

    #[test]
    fn buffers_are_saved_and_loaded_and_not_trained() {
        let mut params = two();
        params.insert_buffer("norm.mean", Tensor::new(&[1f32, 2.0], &Device::Cpu).unwrap()).unwrap();
        assert!(params.insert_buffer("a", Tensor::new(&[1f32], &Device::Cpu).unwrap()).is_err());
        assert_eq!(params.count(), 9);
        assert!(params.iter().all(|(name, _)| name != "norm.mean"));
        let mut tensors = params.tensors();
        let other = two();
        assert!(matches!(other.load(&tensors), Err(ModelError::ExtraTensor { name, .. }) if name == "norm.mean"));
        tensors.insert("norm.mean".into(), Tensor::new(&[3f32, 4.0], &Device::Cpu).unwrap());
        params.load(&tensors).unwrap();
        let (_, mean) = params.buffers().next().unwrap();
        assert_eq!(mean.to_vec1::<f32>().unwrap(), [3.0, 4.0]);
        tensors.remove("norm.mean");
        assert!(matches!(params.load(&tensors), Err(ModelError::MissingTensor { name, .. }) if name == "norm.mean"));
    }

    #[test]
    fn tables_take_as_many_rows_as_come() {
        let rows = |n: usize, columns: usize| Tensor::zeros((n, columns), DType::F32, &Device::Cpu).unwrap();
        let mut params = two();
        params.insert_table("seen", 3).unwrap();
        assert!(
            params.insert_table("a", 3).is_err()
                && params.create("seen", &[1], Init::Ones, &mut Rng::new(0, "init")).is_err()
        );
        assert!(matches!(params.table("seen"), Err(ModelError::MissingTensor { name, .. }) if name == "seen"));
        assert!(params.set_table("seen", &rows(4, 2)).unwrap_err().to_string().contains("[4, 2], expected [4, 3]"));
        assert!(params.set_table("sene", &rows(4, 3)).is_err());
        params.set_table("seen", &rows(4, 3)).unwrap();
        assert_eq!((params.count(), params.table("seen").unwrap().dims()), (9, &[4, 3][..]));
        // a model that was just built takes them from a file, in any number
        let mut other = two();
        other.insert_table("seen", 3).unwrap();
        assert!(matches!(other.load(&two().tensors()), Err(ModelError::MissingTensor { name, .. }) if name == "seen"));
        other.load(&params.tensors()).unwrap();
        assert_eq!(other.table("seen").unwrap().dims(), [4, 3]);
        assert!(matches!(two().load(&params.tensors()), Err(ModelError::ExtraTensor { name, .. }) if name == "seen"));
    }

    #[test]
    fn an_update_is_seen_through_the_layers_tensor() {
        let mut rng = Rng::new(0, "init");
        let mut params = Params::new(&Backend::CPU);
        let held = params.create("w", &[2], Init::Zeros, &mut rng).unwrap();
        params.get("w").unwrap().set(&Tensor::new(&[1f32, 2.0], &Device::Cpu).unwrap()).unwrap();
        assert_eq!(held.to_vec1::<f32>().unwrap(), [1.0, 2.0]);
    }
}
