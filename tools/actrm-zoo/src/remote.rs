//! A policy that a server runs, as an evaluation takes it.

use std::path::{Path, PathBuf};

use anyhow::{Context, bail};
use clap::Args;
use cli::shown;
use models::{ModelError, Policy};
use rollout::Ready;
use serving::{Facts, Mapping, RemotePolicy};
use zoo::conventions::Conventions;
use zoo::entry::{CamerasMeta, Entry};
use zoo::evaluation::Subject;
use zoo::external::{External, Named, usual_inputs};
use zoo::results::Execution;
use zoo::{FeatureKeys, ZooError};

/// Where a policy of others is, and what it is ranked as.
#[derive(Args)]
pub struct RemoteArgs {
    /// Evaluate the policy of this server, which speaks openpi's protocol; needs --name, and --task or --protocol
    #[arg(long, value_name = "ws://HOST:PORT", requires = "name", conflicts_with_all = ["entries", "all", "all_versions"])]
    policy: Option<String>,
    /// Name that the policy of --policy is ranked under
    #[arg(long, value_name = "NAME", requires = "policy")]
    name: Option<String>,
    /// What the server is sent: `actrm` (features under LeRobot's names), `openpi-libero`, or a TOML file
    #[arg(long, value_name = "PRESET|FILE", default_value = "actrm", requires = "policy")]
    mapping: String,
    /// Hash or version of the server's weights; another one is another version of the entry [default: what the server says]
    #[arg(long, value_name = "TEXT", requires = "policy")]
    declared: Option<String>,
    /// Token of the server, sent as `Authorization: Api-Key TOKEN`
    #[arg(long, value_name = "TOKEN", env = "ACTRM_TOKEN", hide_env_values = true)]
    token: Option<String>,
}

impl RemoteArgs {
    /// The policy that was asked about, if it is a server's; the server is asked what it is.
    ///
    /// # Errors
    /// A mapping that cannot be read, a server that cannot be used.
    pub fn policy(&self, task: Option<&str>) -> anyhow::Result<Option<Remote>> {
        let (Some(address), Some(name)) = (&self.policy, &self.name) else { return Ok(None) };
        let Some(task) = task else { bail!("--policy: expected --task or --protocol beside it") };
        let (mapping, text) = mapping(&self.mapping)?;
        let mapping = mapping.of_task(task);
        let facts = Facts::ask(address, self.token.as_deref(), &mapping)?;
        let conventions = conventions(address, &facts, &mapping)?;
        Ok(Some(Remote {
            address: address.clone(),
            token: self.token.clone(),
            task: task.to_owned(),
            named: Named { name: name.clone(), description: format!("The policy that a server runs, on {task}.") },
            declared: self.declared.clone().or_else(|| facts.entry.clone()),
            mapping,
            text,
            facts,
            conventions,
        }))
    }
}

/// What a server says of its conventions, as far as `mapping` leaves it as it is.
fn conventions(address: &str, facts: &Facts, mapping: &Mapping) -> anyhow::Result<Conventions> {
    let said = Conventions::try_from(facts.conventions.clone()).map_err(anyhow::Error::msg);
    let mut said = said.with_context(|| format!("policy server {address}"))?;
    if let Some(horizon) = facts.action_horizon {
        said.set("horizon", horizon);
    }
    if mapping.n_action_steps.is_some() {
        said = said.without(&["executed"]);
    }
    if !mapping.observation.is_empty() {
        said = said.without(&["state", "quaternion", "image_size", "image_flip", "image_channels"]);
    }
    Ok(said)
}

/// The policy of an external entry behind a server, which is asked for it again.
pub struct Served {
    external: External,
    address: String,
    token: Option<String>,
    mapping: Mapping,
    facts: Facts,
}

impl Served {
    /// Asks the server at `address`, or the one that the entry names, whether it is as it was.
    ///
    /// # Errors
    /// An entry whose policy is no server's; a server that cannot be used; other conventions, by name.
    pub fn of(entry: &Entry, address: Option<&str>, token: Option<&str>) -> anyhow::Result<Option<Self>> {
        let Some(external) = External::of(entry)? else { return Ok(None) };
        let id = entry.id();
        let own = Some(external.source.as_str()).filter(|source| source.starts_with("ws://"));
        let Some(address) = address.or(own).map(str::to_owned) else {
            bail!(
                "entry {id}: {} runs in Python: evaluate it again with actrm.evaluate, or name its server with --policy",
                external.source
            );
        };
        let mapping = match external.mapping.as_deref() {
            None => Mapping::default(),
            Some(text) => match text.strip_prefix("preset ").and_then(Mapping::preset) {
                Some(mapping) => mapping,
                None => Mapping::parse("of the entry", text)?,
            },
        };
        let mapping = mapping.of_task(&entry.meta().task);
        let facts = Facts::ask(&address, token, &mapping)?;
        let now = conventions(&address, &facts, &mapping)?;
        external.conventions.check(&now, &address, &id.to_string(), &entry.meta().task)?;
        let token = token.map(str::to_owned);
        Ok(Some(Self { external, address, token, mapping, facts }))
    }

    /// What the server says that it runs.
    pub fn declared(&self) -> Option<&str> {
        self.facts.entry.as_deref()
    }

    /// What its owner declared of the weights when the row was measured.
    pub fn declared_then(&self) -> Option<&str> {
        self.external.declared.as_deref()
    }

    /// What is evaluated.
    pub fn subject(&self, entry: &Entry) -> Subject<'_> {
        let signature = entry.meta().signature.clone();
        self.external.subject(entry, move || {
            connect((&self.address, &self.facts), self.token.as_deref(), &signature, &self.mapping)
        })
    }
}

/// A server's policy, if the server reports the same metadata as when it was asked.
fn connect(
    (address, facts): (&str, &Facts),
    token: Option<&str>,
    signature: &models::Signature,
    mapping: &Mapping,
) -> Result<Box<dyn Policy>, ModelError> {
    let policy = RemotePolicy::connect(address, token, signature, mapping).and_then(|policy| policy.as_asked(facts));
    policy.map(|policy| Box::new(policy) as Box<dyn Policy>).map_err(ModelError::from)
}

/// A mapping and its file's text; none of one that changes nothing.
fn mapping(name: &str) -> anyhow::Result<(Mapping, Option<String>)> {
    if let Some(mapping) = Mapping::preset(name) {
        let text = (mapping != Mapping::default()).then(|| format!("preset {name}"));
        return Ok((mapping, text));
    }
    let presets: Vec<&str> = Mapping::presets().collect();
    let text = std::fs::read_to_string(PathBuf::from(name))
        .with_context(|| format!("--mapping {}: expected {}, or a file", shown(Path::new(name)), presets.join(", ")))?;
    Ok((Mapping::parse(name, &text)?, Some(text)))
}

/// A server's policy.
pub struct Remote {
    address: String,
    token: Option<String>,
    /// The task that it is evaluated on.
    pub task: String,
    named: Named,
    declared: Option<String>,
    mapping: Mapping,
    text: Option<String>,
    facts: Facts,
    /// What the server says of its conventions, as far as the mapping leaves it as it is.
    conventions: Conventions,
}

/// How features of images are named.
const IMAGES: &str = "observation.images.";

impl Remote {
    fn external(&self, inputs: FeatureKeys) -> External {
        let steps = self.mapping.n_action_steps.or(self.facts.n_action_steps).unwrap_or(1);
        let execution = match self.facts.temporal_ensemble.filter(|_| self.mapping.n_action_steps.is_none()) {
            Some(coefficient) => Execution::TemporalEnsemble { coefficient },
            None => Execution::RecedingHorizon { n_action_steps: steps },
        };
        let (source, declared, mapping) = (self.address.clone(), self.declared.clone(), self.text.clone());
        let images = inputs.features().any(|feature| feature.starts_with(IMAGES));
        let (image_size, conventions) = (images.then(|| self.image_size()), self.conventions.clone());
        External { source, declared, mapping, image_size, execution, inputs, conventions }
    }

    /// Side of the images: as the server says of its own, else as the mapping says.
    fn image_size(&self) -> usize {
        let own = self.facts.shapes.iter().find(|(key, _)| key.starts_with(IMAGES));
        own.and_then(|(_, shape)| shape.first().copied()).unwrap_or(self.mapping.image_size)
    }

    /// The features and their keys, as far as server and mapping say them; `None` of a feature with its usual keys.
    fn features(&self) -> Vec<(String, Option<Vec<String>>)> {
        if self.mapping.observation.is_empty() {
            return self.facts.observation_keys.iter().map(|(name, keys)| (name.clone(), Some(keys.clone()))).collect();
        }
        let keys = |feature: &str| Some(vec![format!("{}_image", feature.strip_prefix(IMAGES)?)]);
        self.mapping.observation.iter().map(|item| (item.feature.clone(), keys(&item.feature))).collect()
    }

    /// The cameras that it looks through.
    ///
    /// # Errors
    /// Keys that cannot be read.
    pub fn cameras(&self) -> anyhow::Result<Option<CamerasMeta>> {
        let mut inputs = FeatureKeys::default();
        for (feature, keys) in self.features() {
            if let Some(keys) = keys.filter(|_| feature.starts_with(IMAGES)) {
                insert(&mut inputs, &feature, &keys)?;
            }
        }
        Ok(self.external(inputs).cameras())
    }

    /// Its entry in `zoo`, and what is evaluated in the environment that `ready` describes.
    ///
    /// # Errors
    /// Keys that the environment does not have; a name that is an entry with weights.
    pub fn subject(&self, zoo: &Path, ready: &Ready) -> anyhow::Result<Subject<'_>> {
        let usual = usual_inputs(ready)?;
        let mut inputs = FeatureKeys::default();
        for (feature, keys) in self.features() {
            let keys = keys.unwrap_or_else(|| usual.of(&feature));
            insert(&mut inputs, &feature, &keys)?;
        }
        if inputs.features().next().is_none() {
            inputs = usual;
        }
        let external = self.external(inputs);
        let entry = external.entry(zoo, &self.named, ready)?;
        let signature = entry.meta().signature.clone();
        // what does not fit is said before an episode begins
        self.connect(&signature)?;
        Ok(external.subject(&entry, move || self.connect(&signature)))
    }

    fn connect(&self, signature: &models::Signature) -> Result<Box<dyn Policy>, ModelError> {
        connect((&self.address, &self.facts), self.token.as_deref(), signature, &self.mapping)
    }
}

fn insert(inputs: &mut FeatureKeys, feature: &str, keys: &[String]) -> Result<(), ZooError> {
    inputs.insert(feature, keys).map_err(|found| ZooError::InvalidValue {
        key: feature.to_owned(),
        expected: "observation keys".to_owned(),
        found,
    })
}
