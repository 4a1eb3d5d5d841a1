use std::process::ExitCode;

use anyhow::bail;
use cli::Stop;
use models::FeatureKind;
use rollout::{Agent, Observations};
use serde_json::Value as Json;
use serving::{Limits, Server, Service, Shown, Stepper, Steps, VLA_EVAL_PATH, Value};
use zoo::entry::LoadedEntry;
use zoo::evaluation::PolicyAgent;

use crate::places::{ZooArgs, entry_names};

/// Serve an entry to robots and scripts: openpi's protocol, for `openpi-client` and others
///
/// Clients send observations with the entry's features under LeRobot's names, and get chunks of actions in the units of the
/// data. The first message describes the policy. Each client has an episode of its own. Under `/vla-eval` the protocol is that
/// of vla-eval, which evaluates entries for LIBERO. `GET /healthz` and `GET /metrics` are on the same port. Ctrl-C ends it.
#[derive(clap::Args)]
#[command(after_help = "Examples:
  actrm-zoo serve lift-act
  actrm-zoo serve lift-act@1 --port 8001
  ACTRM_TOKEN=secret actrm-zoo serve lift-act --host 0.0.0.0")]
pub struct Args {
    /// Entry: `name` (its newest version), `name@version`, or its folder
    #[arg(add = entry_names())]
    entry: String,
    /// Address to listen on; one that other machines reach needs a token
    #[arg(long, value_name = "HOST", default_value = "127.0.0.1")]
    host: String,
    /// Port to listen on; 0 takes a free one
    #[arg(long, value_name = "PORT", default_value_t = 8000)]
    port: u16,
    /// Token that clients have to send as `Authorization: Api-Key TOKEN`
    #[arg(long, value_name = "TOKEN", env = "ACTRM_TOKEN", hide_env_values = true)]
    token: Option<String>,
    #[command(flatten)]
    zoo: ZooArgs,
}

pub fn run(args: &Args) -> anyhow::Result<ExitCode> {
    let loaded = args.zoo.registry().locate(&args.entry)?.load()?;
    let id = loaded.entry().id();
    if loaded.subject().is_scripted {
        bail!("entry {id}: its expert acts inside the simulator and cannot be served");
    }
    let stop = Stop::install("stopped")?;
    let server = Server::bind(&args.host, args.port, args.token.clone(), service(loaded), Limits::default())?;
    let address = server.address();
    cli::print(&format!("{id} on ws://{address}\nfor vla-eval: ws://{address}{VLA_EVAL_PATH}\n"))?;
    server.run(&|| stop.asked());
    let queries = server.queries();
    cli::note(&format!("stopped after {queries} {}", if queries == 1 { "query" } else { "queries" }));
    Ok(ExitCode::SUCCESS)
}

/// An entry's policy with what the entry records of its conventions.
fn service(loaded: LoadedEntry) -> Service {
    let (meta, experiment) = (loaded.entry().meta().clone(), loaded.experiment());
    let signature = loaded.preprocess().signature().clone();
    let past = experiment.policy.past_actions(signature.n_obs_steps);
    let action_horizon = loaded.model().action_horizon() - past;
    let keys = meta.keys.features().map(|feature| {
        let keys = meta.keys.of(feature).iter().map(|key| Value::text(key.clone())).collect();
        (feature.to_owned(), Value::List(keys))
    });
    let conventions = loaded.conventions();
    let conventions = conventions.iter().map(|(name, said)| (name.to_owned(), Value::text(said.to_owned())));
    let mut facts = vec![
        ("entry", Value::text(meta.id().to_string())),
        ("policy", Value::text(meta.policy.clone())),
        ("task", Value::text(meta.task.clone())),
        ("observation_keys", Value::map(keys)),
        ("conventions", Value::map(conventions)),
    ];
    if let Some(version) = &meta.env_version {
        facts.push(("env_version", Value::text(version.clone())));
    }
    if let Some(environment) = &meta.env_args {
        if let Some(rate) = environment.pointer("/env_kwargs/control_freq") {
            facts.push(("control_freq", value(rate)));
        }
        facts.push(("env_args", value(environment)));
    }
    let n_action_steps = match experiment.rollout.temporal_ensemble {
        Some(coefficient) => {
            facts.push(("temporal_ensemble", Value::Float(coefficient)));
            1
        }
        None => experiment.rollout.n_action_steps,
    };
    Service {
        signature,
        action_horizon,
        n_action_steps,
        facts: facts.into_iter().map(|(key, value)| (key.to_owned(), value)).collect(),
        steps: Some(steps(loaded.clone())),
        policy: Box::new(move || loaded.policy()),
    }
}

/// The entry's policy, asked at every step in the simulator's terms.
fn steps(loaded: LoadedEntry) -> Steps {
    let meta = loaded.entry().meta();
    let (mut numbers, mut images) = (Vec::new(), Vec::new());
    for spec in &meta.signature.observation {
        let items = meta.keys.items(&spec.name);
        for key in items.iter().flat_map(|item| item.keys()).map(str::to_owned) {
            match (spec.kind, spec.shape.as_slice()) {
                (FeatureKind::Image, &[height, width, _]) => images.push((key, height, width)),
                _ => {
                    // as many numbers as make the feature's width, if the other keys have those of the robot
                    let width_of =
                        |count| items.iter().map(|item| item.width(robot(&key, count))).sum::<Result<usize, _>>();
                    let count = (1..=spec.width()).find(|count| width_of(*count) == Ok(spec.width()));
                    numbers.push((key, count));
                }
            }
        }
    }
    let name = meta.id().to_string();
    let agent = move || {
        let subject = loaded.subject();
        let agent = (subject.policy)().and_then(|policy| subject.acting(policy)).map_err(|error| error.to_string())?;
        Ok(Box::new(Acting(agent)) as Box<dyn Stepper>)
    };
    Steps { name, numbers, images, policy: Box::new(agent) }
}

/// How many numbers keys of the robot have; `count` for `key`.
fn robot(key: &str, count: usize) -> impl Fn(&str) -> Option<usize> {
    move |other| match other {
        _ if other == key => Some(count),
        "robot0_eef_pos" => Some(3),
        "robot0_eef_quat" => Some(4),
        "robot0_gripper_qpos" => Some(2),
        _ => None,
    }
}

/// An agent that a server asks.
struct Acting(PolicyAgent);

impl Stepper for Acting {
    fn begin(&mut self, seed: u64, instruction: Option<&str>) {
        self.0.reset(seed);
        self.0.instruct(instruction);
    }

    fn act(&mut self, shown: Shown) -> Result<Vec<f32>, String> {
        self.0.act(&Observations::new(shown.numbers, shown.images)).map_err(|error| error.to_string())
    }
}

/// JSON as a message has it.
fn value(json: &Json) -> Value<'static> {
    match json {
        Json::Null => Value::Nil,
        Json::Bool(yes) => Value::Bool(*yes),
        Json::Number(number) => match number.as_i128() {
            Some(integer) => Value::Integer(integer),
            None => Value::Float(number.as_f64().unwrap_or(f64::NAN)),
        },
        Json::String(text) => Value::text(text.clone()),
        Json::Array(values) => Value::List(values.iter().map(value).collect()),
        Json::Object(pairs) => Value::map(pairs.iter().map(|(key, json)| (key.clone(), value(json)))),
    }
}
