//! `train.from`: a training that starts from the weights of an entry.

use std::collections::BTreeMap;
use std::path::Path;

use candle_core::Tensor;

use crate::FeatureKeys;
use crate::conventions::Conventions;
use crate::entry::{Entry, EntryId, EntryRequest, MODEL_FILE, ParentMeta};
use crate::experiment::IMAGE_PREFIX;
use crate::{ZooError, tensors};

/// Weights that a training begins with.
pub(super) struct InitialWeights {
    /// The entry that they are of.
    pub parent: ParentMeta,
    conventions: Conventions,
    keys: FeatureKeys,
    weights: BTreeMap<String, Tensor>,
}

impl InitialWeights {
    /// Those of the entry `from`, `name@version`, of `zoo`.
    ///
    /// # Errors
    /// An entry that is not there, is damaged, or has no weights.
    pub fn read(zoo: &Path, from: &str) -> Result<Self, ZooError> {
        let EntryRequest { name, version, .. } = from.parse()?;
        let Some(version) = version else {
            let (key, expected) = ("train.from".to_owned(), "name@version of an entry".to_owned());
            return Err(ZooError::InvalidValue { key, expected, found: from.to_owned() });
        };
        let entry = Entry::open(zoo, &EntryId { name, version })?;
        if entry.meta().is_external() {
            return Err(ZooError::External { entry: entry.id().to_string() });
        }
        let path = entry.folder().join(MODEL_FILE);
        let (weights, _) = tensors::read(&path)?;
        let weights = tensors::in_f32(&path, weights)?;
        let parent = ParentMeta { entry: entry.id().to_string(), content_sha256: entry.meta().content_sha256() };
        Ok(Self { parent, conventions: entry.conventions()?, keys: entry.meta().keys.clone(), weights })
    }

    /// Compares the conventions that the weights were trained by with those of demonstrations called `name`.
    ///
    /// # Errors
    /// [`ZooError::UnfitEntry`] with the first that differs.
    pub fn check(&self, demonstrations: &Conventions, name: &str, task: &str) -> Result<(), ZooError> {
        let said = demonstrations.clone().without(&["image_size"]);
        self.conventions.check(&said, &format!("{name} (--force trains anyway)"), &self.parent.entry, task)
    }

    /// The tensor that begins as `name`, which has the shape of `own`.
    fn of(&self, name: &str, own: &Tensor) -> Option<&Tensor> {
        self.weights.get(name).filter(|given| given.dims() == own.dims())
    }

    /// A model's own tensors, with those in their places that have their name and shape.
    pub fn weights(&self, own: &BTreeMap<String, Tensor>) -> BTreeMap<String, Tensor> {
        let begun = |(name, own): (&String, &Tensor)| (name.clone(), self.of(name, own).unwrap_or(own).clone());
        own.iter().map(begun).collect()
    }

    /// What was taken, what is new, what is not used, and which features, of `keys` now, were made of others, for whoever trains.
    ///
    /// # Errors
    /// [`ZooError::InvalidValue`] where nothing was taken: it is another kind of policy.
    pub fn note(&self, own: &BTreeMap<String, Tensor>, keys: &FeatureKeys) -> Result<String, ZooError> {
        let new: Vec<&String> = own.iter().filter(|(name, own)| self.of(name, own).is_none()).map(|(n, _)| n).collect();
        let unused = self.weights.keys().filter(|name| own.get(*name).is_none_or(|own| self.of(name, own).is_none()));
        let unused: Vec<&String> = unused.collect();
        if new.len() == own.len() {
            return Err(ZooError::InvalidValue {
                key: "train.from".to_owned(),
                expected: format!("an entry with tensors such as {}", names(&new)),
                found: format!("{}, which has {}", self.parent.entry, names(&unused)),
            });
        }
        let mut note = format!("{} of {} tensors begin as in {}", own.len() - new.len(), own.len(), self.parent.entry);
        if !new.is_empty() {
            note.push_str(&format!("; new: {}", names(&new)));
        }
        if !unused.is_empty() {
            note.push_str(&format!("; not used: {}", names(&unused)));
        }
        for feature in keys.features().filter(|feature| !feature.starts_with(IMAGE_PREFIX)) {
            let (there, here) = (self.keys.of(feature), keys.of(feature));
            if !there.is_empty() && there != here {
                note.push_str(&format!("; {feature}: {} in that entry, {} here", there.join(", "), here.join(", ")));
            }
        }
        Ok(note)
    }
}

/// All names, or the first of many.
fn names(all: &[&String]) -> String {
    const MOST: usize = 12;
    let shown: Vec<&str> = all.iter().take(MOST).map(|name| name.as_str()).collect();
    let more = if all.len() > MOST { format!(" and {} more", all.len() - MOST) } else { String::new() };
    shown.join(", ") + &more
}
