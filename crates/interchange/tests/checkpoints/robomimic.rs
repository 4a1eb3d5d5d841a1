//! robomimic 0.3's own checkpoints, its own answers, and files that want something else than being read.
//! `fixtures/robomimic/make.py` made them.

#![allow(clippy::unwrap_used)]

use std::fs;
use std::path::{Path, PathBuf};
use std::process::Command;

use interchange::robomimic::{ImportOptions, import};
use models::Observation;
use safetensors::SafeTensors;
use serde_json::Value;
use zoo::entry::Entry;

/// Largest difference from robomimic's means that counts as equal; they lie in -1 to 1.
const TOLERANCE: f32 = 1e-5;
const HORIZON: usize = 4;
const STEPS: usize = 2 * HORIZON + 1;
const KEYS: [(&str, usize); 4] =
    [("robot0_eef_pos", 3), ("robot0_eef_quat", 4), ("robot0_gripper_qpos", 2), ("object", 10)];

fn fixture(name: &str) -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/fixtures/robomimic").join(name)
}

fn python() -> rollout::Python {
    rollout::find_python(None).unwrap()
}

fn options() -> ImportOptions {
    ImportOptions {
        name: "imported".to_owned(),
        task: "Lift".to_owned(),
        state_keys: KEYS[..3].iter().map(|(key, _)| (*key).to_owned()).collect(),
        env_keys: vec!["object".to_owned()],
    }
}

/// What robomimic saw and what it drew from.
struct Answers {
    file: Vec<u8>,
}

impl Answers {
    fn of(name: &str) -> Self {
        Self { file: fs::read(fixture(&format!("{name}.safetensors"))).unwrap() }
    }

    /// Row `(episode, step)` of a tensor.
    fn row(&self, name: &str, (episode, step): (usize, usize)) -> Vec<f32> {
        let parsed = SafeTensors::deserialize(&self.file).unwrap();
        let view = parsed.tensor(name).unwrap();
        let values: Vec<f32> = view.data().chunks_exact(4).map(|b| f32::from_le_bytes(b.try_into().unwrap())).collect();
        let (rows, width) = (view.shape()[0] * STEPS, values.len() / (view.shape()[0] * STEPS));
        assert!(episode * STEPS + step < rows);
        values[(episode * STEPS + step) * width..][..width].to_vec()
    }

    /// The observation with the state's keys in this order.
    fn seen(&self, place: (usize, usize), keys: &[&str]) -> Observation {
        let joined = |keys: &[&str]| keys.iter().flat_map(|key| self.row(key, place)).collect::<Vec<f32>>();
        Observation::of_state(joined(keys), joined(&["object"]))
    }

    /// The Gaussians' means, the likeliest first.
    fn means(&self, place: (usize, usize)) -> Vec<Vec<f32>> {
        let (logits, means) = (self.row("logits", place), self.row("means", place));
        let mut rows: Vec<(f32, Vec<f32>)> =
            logits.into_iter().zip(means.chunks(means.len() / 3).map(<[f32]>::to_vec)).collect();
        rows.sort_by(|a, b| b.0.total_cmp(&a.0));
        rows.into_iter().map(|(_, mean)| mean).collect()
    }
}

fn away(got: &[f32], expected: &[f32]) -> f32 {
    assert_eq!(got.len(), expected.len());
    got.iter().zip(expected).map(|(a, b)| (a - b).abs()).fold(0.0, f32::max)
}

#[test]
fn imported_checkpoints_answer_as_robomimic_does() {
    // another order of the state's keys is another order of the same numbers
    let turned = ["robot0_gripper_qpos", "robot0_eef_pos", "robot0_eef_quat"];
    for name in ["bc_rnn", "bc_rnn_normalised", "bc_transformer", "bc_gru"] {
        for keys in [KEYS.map(|(key, _)| key)[..3].to_vec(), turned.to_vec()] {
            let zoo = tempfile::tempdir().unwrap();
            let options = ImportOptions { state_keys: keys.iter().map(|key| (*key).to_owned()).collect(), ..options() };
            let id = import(&fixture(&format!("{name}.pth")), &options, &python(), zoo.path()).unwrap();
            let loaded = Entry::open(zoo.path(), &id).unwrap().load().unwrap();
            let answers = Answers::of(name);
            let (model, preprocess) = (loaded.model(), loaded.preprocess());
            let mut largest = 0.0_f32;
            for episode in 0..3 {
                let mut policy = loaded.policy();
                policy.reset(episode as u64);
                for step in 0..STEPS {
                    let place = (episode, step);
                    let expected = answers.means(place);
                    // in a rollout: one of the means, with a noise of 1e-4
                    let drawn = policy.predict(&answers.seen(place, &keys)).unwrap().actions;
                    let near = expected.iter().map(|mean| away(&drawn[..7], mean)).fold(f32::INFINITY, f32::min);
                    assert!(near < 6e-4, "{name} episode {episode} step {step}: {near}");
                    // without the noise: an LSTM's state is new every HORIZON steps, a transformer sees the last ones
                    let rnn = name != "bc_transformer";
                    let (from, row) = if rnn { (step / HORIZON * HORIZON, step % HORIZON) } else { (step, 0) };
                    let at =
                        |i: usize| if rnn { (from + i).min(STEPS - 1) } else { (step + i + 1).saturating_sub(HORIZON) };
                    let history: Vec<_> = (0..HORIZON).map(|i| answers.seen((episode, at(i)), &keys)).collect();
                    let means = model.predict(&preprocess.observation(&history).unwrap()).unwrap();
                    let mean = means.to_vec3::<f32>().unwrap()[0][row].clone();
                    largest = largest.max(away(&mean, &expected[0]));
                }
            }
            println!("{name}: {largest:.1e}");
            assert!(largest <= TOLERANCE, "{name}: {largest:e}");
        }
    }
}

#[test]
fn an_entry_says_where_it_comes_from() {
    let zoo = tempfile::tempdir().unwrap();
    let id = import(&fixture("bc_rnn_normalised.pth"), &options(), &python(), zoo.path()).unwrap();
    let entry = Entry::open(zoo.path(), &id).unwrap();
    let meta = entry.meta();
    assert_eq!((meta.policy.as_str(), meta.experiment.as_str()), ("bc_rnn", "imported from robomimic"));
    assert_eq!((meta.env_name.as_deref(), meta.env_version.as_deref()), (Some("Lift"), Some("1.5.2")));
    assert_eq!(meta.license(), "unknown");
    // robots and controllers come with it; which module is imported is not the file's to say
    assert_eq!(meta.env_args.as_ref().unwrap()["env_kwargs"]["robots"], "Panda");
    assert!(meta.env_module.is_none() && meta.env_args.as_ref().unwrap().get("env_module").is_none());
    let loaded = entry.load().unwrap();
    assert_eq!(loaded.experiment().rollout.n_action_steps, 1);
    let text = loaded.experiment().to_toml();
    for line in
        ["action = \"identity\"", "state = \"mean_std\"", "action_horizon = 4", "n_modes = 3", "n_obs_steps = 4"]
    {
        assert!(text.contains(line), "{line} in\n{text}");
    }
}

/// What the harness reads of a fixture.
fn stored() -> Value {
    let path = fixture("bc_rnn_normalised.pth");
    zoo::tensors::from_bytes(&path, &rollout::read_robomimic(&python(), &path).unwrap()).unwrap().1
}

#[test]
fn what_ours_cannot_hold_is_refused_by_name() {
    let good = stored();
    let keys = options();
    let read = |stored: &Value| models::robomimic::read_checkpoint(stored, &keys.state_keys, &keys.env_keys);
    read(&good).unwrap();
    let changed = |path: &[&str], value: Value| {
        let mut stored = good.clone();
        let mut config: Value = serde_json::from_str(stored["config"].as_str().unwrap()).unwrap();
        let place = path.iter().fold(&mut config, |at, key| &mut at[*key]);
        assert_ne!(*place, value, "{path:?}");
        *place = value;
        stored["config"] = Value::String(config.to_string());
        stored
    };
    let off = Value::Bool(false);
    for (path, value) in [
        (&["algo", "rnn", "rnn_type"][..], Value::from("RNN")),
        (&["algo", "rnn", "open_loop"], true.into()),
        (&["algo", "rnn", "kwargs", "bidirectional"], true.into()),
        (&["algo", "rnn", "kwargs", "proj_size"], 3.into()),
        (&["algo", "rnn", "hidden_dim"], 0.into()),
        (&["algo", "gmm", "enabled"], off.clone()),
        (&["algo", "gmm", "std_activation"], "exp".into()),
        (&["algo", "gmm", "low_noise_eval"], off.clone()),
        (&["algo", "gmm", "temperature"], 2.0.into()),
        (&["algo", "gaussian", "enabled"], true.into()),
        (&["algo", "vae", "enabled"], true.into()),
        (&["algo", "actor_layer_dims"], serde_json::json!([400])),
        (&["algo", "language"], true.into()),
        (&["train", "frame_stack"], 2.into()),
        (&["train", "hdf5_normalize_obs"], off),
        (&["observation", "modalities", "obs", "rgb"], serde_json::json!(["agentview_image"])),
        (&["observation", "modalities", "goal", "low_dim"], serde_json::json!(["object"])),
        (&["observation", "encoder", "low_dim", "core_class"], "MLP".into()),
    ] {
        let error = read(&changed(path, value)).unwrap_err().to_string();
        let name = if path[0] == "observation" { path[1] } else { path[path.len() - 1] };
        assert!(error.contains(name) || name == "hdf5_normalize_obs" && error.contains("obs_normalization"), "{error}");
    }
    for (field, value, named) in [
        ("algo_name", Value::from("bcq"), "algo_name is bcq, expected bc"),
        ("format", 2.into(), "format is 2"),
        ("config", "{}".into(), "missing field `algo`"),
        ("all_shapes", serde_json::json!([["object", [10]]]), "all_shapes"),
        ("all_shapes", serde_json::json!([["object", [u64::MAX]]]), "one dimension of at most"),
        ("obs_normalization_stats", serde_json::json!({}), "obs_normalization_stats is nothing"),
    ] {
        let mut stored = good.clone();
        stored[field] = value;
        let error = read(&stored).unwrap_err().to_string();
        assert!(error.contains(named), "{error}");
    }
    let mut narrow = good.clone();
    narrow["obs_normalization_stats"]["object"]["std"] = serde_json::json!([[1.0, 2.0]]);
    let error = read(&narrow).unwrap_err().to_string();
    assert!(error.contains("object.std of 2 numbers"), "{error}");
    let of_keys = |state: &[&str], env: &[&str]| {
        let owned = |keys: &[&str]| keys.iter().map(|key| (*key).to_owned()).collect::<Vec<_>>();
        models::robomimic::read_checkpoint(&good, &owned(state), &owned(env)).unwrap_err().to_string()
    };
    assert!(of_keys(&["robot0_eef_pos", "robot0_eef_pos"], &[]).contains("robot0_eef_pos in the state"));
    assert!(of_keys(&["robot0_eef_pos", "cube"], &[]).contains("cube in the state"));
    assert!(of_keys(&["robot0_eef_pos", "robot0_eef_quat"], &["object"]).contains("robot0_gripper_qpos in neither"));
}

#[test]
fn weights_of_another_size_are_refused_before_a_model_is_built() {
    let path = fixture("bc_rnn.pth");
    let bytes = rollout::read_robomimic(&python(), &path).unwrap();
    let (tensors, mut stored) = zoo::tensors::from_bytes(&path, &bytes).unwrap();
    let config = stored["config"].as_str().unwrap().to_owned();
    for (from, to) in
        [("\"hidden_dim\": 8", "\"hidden_dim\": 4000000"), ("\"num_modes\": 3", "\"num_modes\": 1000000000")]
    {
        assert!(config.contains(from));
        stored["config"] = Value::String(config.replace(from, to));
        let options = options();
        let read = models::robomimic::read_checkpoint(&stored, &options.state_keys, &options.env_keys).unwrap();
        let error = read.weights(&tensors).unwrap_err().to_string();
        assert!(error.contains("expected"), "{error}");
    }
}

#[test]
fn weights_that_are_not_robomimics_are_refused_by_name() {
    let of = |name: &str| {
        let path = fixture(&format!("{name}.pth"));
        let bytes = rollout::read_robomimic(&python(), &path).unwrap();
        let (tensors, stored) = zoo::tensors::from_bytes(&path, &bytes).unwrap();
        let keys = options();
        (models::robomimic::read_checkpoint(&stored, &keys.state_keys, &keys.env_keys).unwrap(), tensors)
    };
    let (rnn, tensors) = of("bc_rnn");
    rnn.weights(&tensors).unwrap();
    let refused = |change: &dyn Fn(&mut std::collections::BTreeMap<String, candle_core::Tensor>)| {
        let mut changed = tensors.clone();
        change(&mut changed);
        rnn.weights(&changed).unwrap_err().to_string()
    };
    let (head, copy) = ("policy.nets.decoder.nets.mean.bias", "policy.nets.rnn.per_step_net.nets.mean.bias");
    let error = refused(&|t| drop(t.insert(copy.to_owned(), (&t[copy] + 1e-3).unwrap())));
    assert!(error.contains(copy) && error.contains("differs from its copy"), "{error}");
    let error = refused(&|t| drop((t.remove(copy), t.remove(head))));
    assert!(error.contains("tensor decoder.mean.bias is missing"), "{error}");
    let error = refused(&|t| drop(t.insert("optimizer.state".to_owned(), t[head].clone())));
    assert!(error.contains("optimizer.state does not belong"), "{error}");
    let first = "policy.nets.rnn.nets.weight_ih_l0";
    let error = refused(&|t| drop(t.insert(first.to_owned(), t[first].narrow(1, 0, 18).unwrap())));
    assert!(error.contains(first) && error.contains("expected [32, 19]"), "{error}");

    let (transformer, mut tensors) = of("bc_transformer");
    transformer.weights(&tensors).unwrap();
    let mask = "policy.nets.transformer.nets.transformer.1.nets.attention.mask";
    tensors.insert(mask.to_owned(), tensors[mask].ones_like().unwrap());
    let error = transformer.weights(&tensors).unwrap_err().to_string();
    assert!(error.contains(mask) && error.contains("after it"), "{error}");
}

/// The error of importing a file that Python code makes at `path`, beside which nothing may happen.
fn refused(make: &str) -> String {
    let root = tempfile::tempdir().unwrap();
    let (path, zoo, touched) = (root.path().join("model.pth"), root.path().join("zoo"), root.path().join("touched"));
    let done = Command::new(python().path)
        .args(["-c", make])
        .args([&path, &fixture("bc_rnn.pth"), &touched])
        .output()
        .unwrap();
    assert!(done.status.success(), "{}", String::from_utf8_lossy(&done.stderr));
    let error = import(&path, &options(), &python(), &zoo).unwrap_err().to_string();
    assert!(!zoo.exists(), "nothing may be left of a refused import");
    assert!(!touched.exists(), "the file was run");
    assert!(error.contains("model.pth"), "{error}");
    error
}

#[test]
fn a_pickle_that_wants_to_run_something_is_refused_by_the_name_of_it() {
    // what everybody's torch.load runs
    let error = refused(
        "import os, pickle, sys, zipfile
class Command:
    def __reduce__(self):
        return os.system, ('touch ' + sys.argv[3],)
with zipfile.ZipFile(sys.argv[1], 'w') as out:
    out.writestr('model/data.pkl', pickle.dumps({'model': {}, 'config': Command()}, 2))",
    );
    assert!(error.contains("global posix.system is not allowed"), "{error}");
}

#[test]
fn half_a_file_is_refused() {
    let half = "import sys; d = open(sys.argv[2], 'rb').read(); open(sys.argv[1], 'wb').write(d[:len(d) // 2])";
    let error = refused(half);
    assert!(error.contains("expected a zip archive"), "{error}");
    let error = refused("import sys; open(sys.argv[1], 'w')");
    assert!(error.contains("expected a zip archive"), "{error}");
    let missing = import(Path::new("/no/such.pth"), &options(), &python(), Path::new("/no/zoo")).unwrap_err();
    assert!(missing.to_string().contains("No such file"), "{missing}");
}
