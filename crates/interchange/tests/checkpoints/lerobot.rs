//! LeRobot 0.6.1's own checkpoints, its own answers, and the way back. `fixtures/lerobot/make.py` made them.

#![allow(clippy::unwrap_used)]

use std::fs;
use std::path::{Path, PathBuf};

use interchange::lerobot::{ImportOptions, export, import};
use models::{Observation, Policy};
use safetensors::SafeTensors;
use safetensors::tensor::{Dtype, TensorView, serialize};
use zoo::entry::Entry;

fn fixture(name: &str) -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/fixtures/lerobot").join(name)
}

fn options() -> ImportOptions {
    ImportOptions {
        name: "imported".to_owned(),
        task: "Lift".to_owned(),
        state_keys: None,
        env_keys: None,
        fast_render: false,
    }
}

fn floats(file: &[u8], name: &str) -> Vec<f32> {
    let parsed = SafeTensors::deserialize(file).unwrap();
    let view = parsed.tensor(name).unwrap();
    view.data().chunks_exact(4).map(|b| f32::from_le_bytes(b.try_into().unwrap())).collect()
}

/// The largest difference from LeRobot's actions, raw observation to raw action.
fn difference(entry: &Entry, folder: &Path) -> f32 {
    let io = fs::read(folder.join("io.safetensors")).unwrap();
    let (state, env, actions) = (floats(&io, "state"), floats(&io, "environment_state"), floats(&io, "actions"));
    let mut policy = entry.load().unwrap().policy();
    let rows = state.chunks(9).zip(env.chunks(10)).zip(actions.chunks(8 * 7));
    assert_eq!(rows.len(), 5);
    let mut largest = 0.0_f32;
    for ((state, env), expected) in rows {
        let observation = Observation::of_state(state.to_vec(), env.to_vec());
        let chunk = policy.predict(&observation).unwrap();
        assert_eq!((chunk.action_horizon, chunk.action_dim), (8, 7));
        for (got, expected) in chunk.actions.iter().zip(expected) {
            largest = largest.max((got - expected).abs());
        }
    }
    largest
}

#[test]
fn imported_checkpoints_answer_as_lerobot_does() {
    for name in ["environment_raw", "environment_normalised"] {
        let zoo = tempfile::tempdir().unwrap();
        let id = import(&fixture(name), &options(), zoo.path()).unwrap();
        let entry = Entry::open(zoo.path(), &id).unwrap();
        assert_eq!(entry.meta().policy, "act");
        assert_eq!(entry.load().unwrap().experiment().rollout.n_action_steps, 4);
        let largest = difference(&entry, &fixture(name));
        assert!(largest <= 1e-5, "{name}: {largest:e}");
    }
}

#[test]
fn what_is_exported_comes_back_the_same() {
    for name in ["environment_raw", "environment_normalised"] {
        let root = tempfile::tempdir().unwrap();
        let zoo = root.path().join("zoo");
        let first = Entry::open(&zoo, &import(&fixture(name), &options(), &zoo).unwrap()).unwrap();
        let out = root.path().join("exported");
        export(&first, &out).unwrap();
        let theirs = fs::read(fixture(name).join("model.safetensors")).unwrap();
        let ours = fs::read(out.join("model.safetensors")).unwrap();
        let names = |file: &[u8]| {
            let parsed = SafeTensors::deserialize(file).unwrap();
            let mut all: Vec<_> = parsed.iter().map(|(n, v)| (n.to_owned(), v.shape().to_vec())).collect();
            all.sort();
            all
        };
        assert_eq!(names(&ours), names(&theirs));
        let second = Entry::open(&zoo, &import(&out, &options(), &zoo).unwrap()).unwrap();
        assert_eq!(second.meta().files["model.safetensors"], first.meta().files["model.safetensors"]);
        assert_eq!(second.meta().content_sha256(), first.meta().content_sha256());
        let error = export(&first, &out).unwrap_err().to_string();
        assert!(error.contains("exported"), "{error}");
    }
}

#[test]
fn an_entry_that_went_out_and_in_still_says_what_it_was_trained_on() {
    let root = tempfile::tempdir().unwrap();
    let (zoo, out) = (root.path().join("zoo"), root.path().join("exported"));
    let shipped = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../zoo");
    let first = Entry::open(&shipped, &zoo::entry::EntryId { name: "lift-act".to_owned(), version: 1 }).unwrap();
    export(&first, &out).unwrap();
    let again = |name: &str| {
        let options = ImportOptions { name: name.to_owned(), ..options() };
        Entry::open(&zoo, &import(&out, &options, &zoo).unwrap()).unwrap()
    };
    let (before, after) = (first.meta(), again("back").meta().clone());
    assert!(before.data.is_some() && before.training.is_some() && before.env_version.is_some());
    assert_eq!((&after.data, &after.training), (&before.data, &before.training));
    assert_eq!((&after.env_name, &after.env_version), (&before.env_name, &before.env_version));
    assert!(after.experiment.contains("act_lift, exported to LeRobot as lift-act@1"), "{}", after.experiment);
    let parent = after.parent.as_ref().unwrap();
    assert_eq!((parent.entry.as_str(), parent.content_sha256.as_str()), ("lift-act@1", &*before.content_sha256()));
    assert_eq!(after.license(), "apache-2.0");
    let other_task = ImportOptions { task: "Stack".to_owned(), ..options() };
    let error = import(&out, &other_task, &zoo).unwrap_err().to_string();
    assert!(error.contains("--task") && error.contains("Lift"), "{error}");
    assert_eq!(after.keys, before.keys);
    let turned = ImportOptions { state_keys: Some(vec!["robot0_gripper_qpos".to_owned()]), ..options() };
    let error = import(&out, &turned, &zoo).unwrap_err().to_string();
    assert!(error.contains("--state-keys") && error.contains("found robot0_gripper_qpos"), "{error}");
    // another step before the network changes what it reads
    let processor = out.join("policy_preprocessor.json");
    let plain = fs::read_to_string(&processor).unwrap();
    let mut steps: serde_json::Value = serde_json::from_str(&plain).unwrap();
    for (change, word) in
        [("relative_actions_processor", "relative_actions_processor"), ("", "normalize_observation_keys")]
    {
        let mut changed = steps.clone();
        let all = changed["steps"].as_array_mut().unwrap();
        match change {
            "" => {
                let step = all.iter_mut().find(|step| step["registry_name"] == "normalizer_processor").unwrap();
                step["config"]["normalize_observation_keys"] = serde_json::json!(["observation.state"]);
            }
            name => all.push(serde_json::json!({"registry_name": name, "config": {"enabled": true}})),
        }
        fs::write(&processor, changed.to_string()).unwrap();
        let error = import(&out, &options(), &zoo).unwrap_err().to_string();
        assert!(error.contains(word), "{error}");
    }
    let off = serde_json::json!({"registry_name": "relative_actions_processor", "config": {"enabled": false}});
    steps["steps"].as_array_mut().unwrap().push(off);
    fs::write(&processor, steps.to_string()).unwrap();
    import(&out, &options(), &zoo).unwrap();
    fs::write(&processor, plain).unwrap();
    // trained further elsewhere: the weights are others, and of other origin
    let model = out.join("model.safetensors");
    let mut bytes = fs::read(&model).unwrap();
    let last = bytes.len() - 1;
    bytes[last] ^= 1;
    fs::write(&model, bytes).unwrap();
    let trained_further = again("further").meta().clone();
    assert_eq!((&trained_further.parent, trained_further.license()), (&None, "unknown"));
    assert_eq!((trained_further.data, trained_further.training), (None, None));
    assert_eq!(trained_further.experiment, "imported from LeRobot");
}

#[test]
fn a_module_that_an_export_names_is_left_out() {
    let root = tempfile::tempdir().unwrap();
    let (zoo, out) = (root.path().join("zoo"), root.path().join("exported"));
    let shipped = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../zoo");
    let first = Entry::open(&shipped, &zoo::entry::EntryId { name: "lift-act".to_owned(), version: 1 }).unwrap();
    export(&first, &out).unwrap();
    let path = out.join("actrm_provenance.json");
    let mut provenance: serde_json::Value = serde_json::from_slice(&fs::read(&path).unwrap()).unwrap();
    let module = serde_json::json!({"name": "somebody.elses", "sha256": "0".repeat(64)});
    provenance["meta"]["env_args"] = serde_json::json!({"env_kwargs": {"robots": "Panda"}, "env_module": module});
    provenance["meta"]["env_module"] = module;
    fs::write(&path, provenance.to_string()).unwrap();
    let entry = Entry::open(&zoo, &import(&out, &options(), &zoo).unwrap()).unwrap();
    assert_eq!(entry.meta().env_module, None);
    assert_eq!(entry.meta().env_args, Some(serde_json::json!({"env_kwargs": {"robots": "Panda"}})));
}

/// A copy of a fixture in `root`.
fn copied(root: &Path, name: &str) -> PathBuf {
    let copy = root.join("checkpoint");
    fs::create_dir(&copy).unwrap();
    for item in fs::read_dir(fixture(name)).unwrap() {
        let item = item.unwrap();
        fs::copy(item.path(), copy.join(item.file_name())).unwrap();
    }
    copy
}

/// Every tensor of a safetensors file with its shape and the bytes of its f32.
fn f32_tensors(path: &Path) -> Vec<(String, Vec<usize>, Vec<u8>)> {
    let bytes = fs::read(path).unwrap();
    let parsed = SafeTensors::deserialize(&bytes).unwrap();
    let all = parsed.iter().inspect(|(_, view)| assert_eq!(view.dtype(), Dtype::F32));
    all.map(|(name, view)| (name.to_owned(), view.shape().to_vec(), view.data().to_vec())).collect()
}

fn write_tensors(path: &Path, dtype: Dtype, tensors: &[(String, Vec<usize>, Vec<u8>)]) {
    let views =
        tensors.iter().map(|(name, shape, data)| (name.as_str(), TensorView::new(dtype, shape.clone(), data).unwrap()));
    fs::write(path, serialize(views, None).unwrap()).unwrap();
}

#[test]
fn weights_of_other_floating_point_types_are_read() {
    type Stored = fn(f32) -> Vec<u8>;
    // what rounding to them does to an action
    let kinds: [(Dtype, Stored, f32); 3] = [
        (Dtype::F64, |x| f64::from(x).to_le_bytes().to_vec(), 1e-5),
        (Dtype::F16, |x| half::f16::from_f32(x).to_le_bytes().to_vec(), 1e-2),
        (Dtype::BF16, |x| half::bf16::from_f32(x).to_le_bytes().to_vec(), 1e-1),
    ];
    for (dtype, stored, tolerance) in kinds {
        let root = tempfile::tempdir().unwrap();
        let copy = copied(root.path(), "environment_raw");
        let model = copy.join("model.safetensors");
        let mut tensors = f32_tensors(&model);
        for (_, _, data) in &mut tensors {
            *data = data.as_chunks().0.iter().flat_map(|bytes| stored(f32::from_le_bytes(*bytes))).collect();
        }
        write_tensors(&model, dtype, &tensors);
        let zoo = root.path().join("zoo");
        let entry = Entry::open(&zoo, &import(&copy, &options(), &zoo).unwrap()).unwrap();
        let largest = difference(&entry, &copy);
        assert!(largest <= tolerance, "{dtype:?}: {largest:e}");
    }
}

#[test]
fn weights_in_several_files_are_the_same_entry() {
    let root = tempfile::tempdir().unwrap();
    let (copy, zoo) = (copied(root.path(), "environment_raw"), root.path().join("zoo"));
    let one = Entry::open(&zoo, &import(&copy, &options(), &zoo).unwrap()).unwrap();
    let tensors = f32_tensors(&copy.join("model.safetensors"));
    fs::remove_file(copy.join("model.safetensors")).unwrap();
    let mut map = serde_json::Map::new();
    for (part, tensors) in tensors.chunks(tensors.len().div_ceil(3)).enumerate() {
        let file = format!("model-{:05}-of-00003.safetensors", part + 1);
        write_tensors(&copy.join(&file), Dtype::F32, tensors);
        map.extend(tensors.iter().map(|(name, ..)| (name.clone(), file.clone().into())));
    }
    let index = serde_json::json!({"metadata": {"total_size": 1}, "weight_map": map});
    fs::write(copy.join("model.safetensors.index.json"), index.to_string()).unwrap();
    let parts = Entry::open(&zoo, &import(&copy, &options(), &zoo).unwrap()).unwrap();
    assert_eq!(parts.meta().content_sha256(), one.meta().content_sha256());
    fs::remove_file(copy.join("model-00002-of-00003.safetensors")).unwrap();
    let error = import(&copy, &options(), &zoo).unwrap_err().to_string();
    assert!(error.contains("model-00002-of-00003.safetensors"), "{error}");
}

/// Moves the statistics of a checkpoint's processors into its weights, where LeRobot 0.3 had them.
fn make_older(copy: &Path) {
    let model = copy.join("model.safetensors");
    let mut tensors = f32_tensors(&model);
    for (name, prefixes) in [
        ("policy_preprocessor_step_3_normalizer_processor", &["normalize_inputs", "normalize_targets"][..]),
        ("policy_postprocessor_step_0_unnormalizer_processor", &["unnormalize_outputs"]),
    ] {
        let path = copy.join(format!("{name}.safetensors"));
        for (name, shape, data) in f32_tensors(&path) {
            let (feature, statistic) = name.rsplit_once('.').unwrap();
            // LeRobot had buffers of what it normalised alone
            let used = ["mean", "std"].contains(&statistic)
                && ["action", "observation"].iter().any(|of| feature.starts_with(of));
            for prefix in
                prefixes.iter().filter(|prefix| used && (feature == "action") != (**prefix == "normalize_inputs"))
            {
                tensors.push((
                    format!("{prefix}.buffer_{}.{statistic}", feature.replace('.', "_")),
                    shape.clone(),
                    data.clone(),
                ));
            }
        }
        fs::remove_file(path).unwrap();
    }
    write_tensors(&model, Dtype::F32, &tensors);
    for name in ["policy_preprocessor.json", "policy_postprocessor.json"] {
        fs::remove_file(copy.join(name)).unwrap();
    }
}

#[test]
fn checkpoints_with_statistics_among_the_weights_are_read() {
    for name in ["environment_raw", "environment_normalised"] {
        let root = tempfile::tempdir().unwrap();
        let (copy, zoo) = (copied(root.path(), name), root.path().join("zoo"));
        let later = Entry::open(&zoo, &import(&copy, &options(), &zoo).unwrap()).unwrap();
        make_older(&copy);
        let older = Entry::open(&zoo, &import(&copy, &options(), &zoo).unwrap()).unwrap();
        assert_eq!(older.meta().content_sha256(), later.meta().content_sha256(), "{name}");
    }
    let text = refusal(|f| {
        make_older(f);
        rename(
            &f.join("model.safetensors"),
            "unnormalize_outputs.buffer_action.std",
            "unnormalize_outputs.buffer_action.stx",
        );
    });
    assert!(text.contains("action.std"), "{text}");
}

#[test]
fn what_lerobot_says_of_a_training_is_recorded() {
    let root = tempfile::tempdir().unwrap();
    let (copy, zoo) = (copied(root.path(), "environment_raw"), root.path().join("zoo"));
    let text = r#"{"dataset": {"repo_id": "me/lift"}, "batch_size": 8, "steps": 100000, "seed": 1000}"#;
    fs::write(copy.join("train_config.json"), text).unwrap();
    fs::create_dir(root.path().join("training_state")).unwrap();
    let imported = || Entry::open(&zoo, &import(&copy, &options(), &zoo).unwrap()).unwrap().meta().experiment.clone();
    assert_eq!(imported(), "imported from LeRobot, trained on me/lift, 100000 steps of 8, seed 1000");
    fs::write(root.path().join("training_state/training_step.json"), r#"{"step": 20000}"#).unwrap();
    assert_eq!(imported(), "imported from LeRobot, trained on me/lift, 20000 steps of 8, seed 1000");
}

/// A copy of a fixture in which one file was changed, and the error that importing it gives.
fn refusal(change: impl Fn(&Path)) -> String {
    let root = tempfile::tempdir().unwrap();
    let copy = copied(root.path(), "environment_raw");
    change(&copy);
    let zoo = root.path().join("zoo");
    let error = import(&copy, &options(), &zoo).unwrap_err();
    assert!(!zoo.exists(), "nothing may be left of a refused import");
    let mut text = error.to_string();
    let mut source = std::error::Error::source(&error);
    while let Some(cause) = source {
        text.push_str(&format!(": {cause}"));
        source = cause.source();
    }
    text
}

fn edit(path: &Path, from: &str, to: &str) {
    let text = fs::read_to_string(path).unwrap();
    assert!(text.contains(from));
    fs::write(path, text.replace(from, to)).unwrap();
}

/// Replaces text in the header of a safetensors file by text of the same length.
fn rename(path: &Path, from: &str, to: &str) {
    let mut bytes = fs::read(path).unwrap();
    let at = bytes.windows(from.len()).position(|w| w == from.as_bytes()).unwrap();
    bytes[at..at + to.len()].copy_from_slice(to.as_bytes());
    fs::write(path, bytes).unwrap();
}

#[test]
fn a_renamed_tensor_is_an_error_that_names_it() {
    let text = refusal(|f| rename(&f.join("model.safetensors"), "model.action_head.bias", "model.action_haed.bias"));
    assert!(text.contains("action_head.bias") || text.contains("action_haed.bias"), "{text}");
}

#[test]
fn a_missing_statistic_is_an_error_that_names_it() {
    let file = "policy_postprocessor_step_0_unnormalizer_processor.safetensors";
    let text = refusal(|f| rename(&f.join(file), "action.std", "action.stx"));
    assert!(text.contains("action.std"), "{text}");
}

#[test]
fn what_we_cannot_run_is_refused() {
    let text = refusal(|f| edit(&f.join("config.json"), "\"type\": \"act\"", "\"type\": \"smolvla\""));
    assert!(text.contains("type is smolvla, expected act or diffusion"), "{text}");
    // a diffusion policy has other keys
    let text = refusal(|f| edit(&f.join("config.json"), "\"type\": \"act\"", "\"type\": \"diffusion\""));
    assert!(text.contains("LeRobot diffusion") && text.contains("chunk_size"), "{text}");
    let text = refusal(|f| edit(&f.join("config.json"), "\"n_heads\"", "\"n_haeds\""));
    assert!(text.contains("n_haeds"), "{text}");
    let text =
        refusal(|f| edit(&f.join("policy_preprocessor.json"), "\"STATE\": \"MEAN_STD\"", "\"STATE\": \"QUANTILES\""));
    assert!(text.contains("QUANTILES"), "{text}");
    let text = refusal(|f| fs::remove_file(f.join("policy_preprocessor.json")).unwrap());
    assert!(text.contains("policy_preprocessor.json"), "{text}");
    // a pipe there, which waits for ever, is refused alike
    let text = refusal(|f| {
        fs::remove_file(f.join("config.json")).unwrap();
        std::os::unix::fs::symlink("/dev/null", f.join("config.json")).unwrap();
    });
    assert!(text.contains("config.json") && text.contains("a device or a socket"), "{text}");
}
