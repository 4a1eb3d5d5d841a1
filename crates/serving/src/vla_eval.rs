//! vla-eval's protocol, as its runner speaks it: an observation of LIBERO for every step, an action in answer.
//!
//! Every message is a map of `type`, `payload`, `seq` and `timestamp`; an answer has the `seq` of its question. The runner says
//! hello, then for each episode `episode_start`, observations and `episode_end`. Written after vla-eval 0.8.0.

use std::collections::BTreeMap;
use std::io::Cursor;
use std::time::{SystemTime, UNIX_EPOCH};

use crate::codec::{Value, decode, encode, shown};
use crate::error::{Result, ServingError};
use crate::mapping::Flip;
use crate::resize::resize_with_pad;
use crate::session::integer;

/// Where a server speaks this protocol.
pub const PATH: &str = "/vla-eval";
/// The protocol's version.
const VERSION: u64 = 1;
/// Side of an image at most, in pixels.
const MOST_SIDE: usize = 1024;
/// The runner's cameras and the simulator's keys of their images, upright, and upside down as LIBERO's files hold them. The
/// runner turns the latter by half a circle.
const CAMERAS: [(&str, &str, Flip); 4] = [
    ("agentview", "agentview_image", Flip::Horizontal),
    ("wrist", "robot0_eye_in_hand_image", Flip::Horizontal),
    ("agentview", "agentview_rgb_image", Flip::Both),
    ("wrist", "eye_in_hand_rgb_image", Flip::Both),
];
/// The simulator's keys of a state, its own and those of LIBERO's files: position, quaternion (x, y, z, w) or axis-angle,
/// finger joints.
const STATE: [&str; 7] =
    ["robot0_eef_pos", "robot0_eef_quat", "robot0_gripper_qpos", "ee_pos", "ee_ori", "ee_states", "gripper_states"];
/// Its key of the task: 1 at the task's number.
const TASK: &str = "task_onehot";
/// Suites whose tasks have the numbers that they have in LIBERO: its own, and LIBERO-PRO's of these endings.
const SUITES: [&str; 5] = ["libero_spatial", "libero_object", "libero_goal", "libero_10", "libero_90"];
const ENDINGS: [&str; 4] = ["", "_swap", "_object", "_lan"];

/// What is shown at a step, under the simulator's names.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct Shown {
    /// Numbers by key.
    pub numbers: BTreeMap<String, Vec<f64>>,
    /// Pixels by key: rows from the top, red, green and blue.
    pub images: BTreeMap<String, Vec<u8>>,
}

/// A policy that is asked at every step of an episode.
pub trait Stepper {
    /// Begins the episode of `seed`; `instruction` says what is to be done.
    fn begin(&mut self, seed: u64, instruction: Option<&str>);

    /// The action of this step.
    ///
    /// # Errors
    /// In words, why there is none.
    fn act(&mut self, shown: Shown) -> std::result::Result<Vec<f32>, String>;
}

/// What is served step by step.
pub struct Steps {
    /// What the policy is called.
    pub name: String,
    /// The simulator's keys of the numbers that it reads, and how many each has where that is known.
    pub numbers: Vec<(String, Option<usize>)>,
    /// The simulator's keys of the images that it reads, with their height and width.
    pub images: Vec<(String, usize, usize)>,
    /// Makes the policy of one client.
    pub policy: Box<dyn Fn() -> std::result::Result<Box<dyn Stepper>, String> + Send + Sync>,
}

/// One client's policy and where its episode is.
pub(crate) struct Session<'a> {
    steps: &'a Steps,
    policy: Option<Box<dyn Stepper>>,
    suite: String,
    task: Option<usize>,
}

/// A message's parts.
struct Envelope<'m, 'a> {
    kind: &'m str,
    payload: &'m Value<'a>,
    seq: i128,
}

impl<'m, 'a> Envelope<'m, 'a> {
    fn of(message: &'m Value<'a>) -> Result<Self> {
        let part = |key: &str, expected: &str| {
            let found = || format!("no such key in {message}");
            message.get(key).ok_or_else(|| ServingError::message(key, expected, found()))
        };
        let Value::Text(kind) = part("type", "a message's type")? else {
            return Err(ServingError::message("type", "a text", "another value"));
        };
        let seq = match part("seq", "a message's number")? {
            Value::Integer(seq) => *seq,
            other => return Err(ServingError::message("seq", "an integer", other.to_string())),
        };
        Ok(Self { kind, payload: part("payload", "a map")?, seq })
    }
}

/// A message of ours.
pub(crate) fn message(kind: &str, payload: Value<'static>, seq: i128) -> Vec<u8> {
    let now = SystemTime::now().duration_since(UNIX_EPOCH).unwrap_or_default().as_secs_f64();
    let parts = [
        ("type", Value::text(kind.to_owned())),
        ("payload", payload),
        ("seq", Value::Integer(seq)),
        ("timestamp", Value::Float(now)),
    ];
    encode(&Value::map(parts))
}

/// The message that says what is wrong.
pub(crate) fn error(text: String, seq: i128) -> Vec<u8> {
    message("error", Value::map([("error", Value::text(text))]), seq)
}

impl<'a> Session<'a> {
    pub fn new(steps: &'a Steps) -> Self {
        Self { steps, policy: None, suite: String::new(), task: None }
    }

    /// Another one, without an episode.
    pub fn anew(&self) -> Self {
        Self::new(self.steps)
    }

    /// The answer to a message, where it asks for one.
    ///
    /// # Errors
    /// What is wrong, and the number of the message that it is about.
    pub fn answer(&mut self, bytes: &[u8]) -> std::result::Result<Option<Vec<u8>>, (ServingError, i128)> {
        let whole = decode(bytes).map_err(|error| (error, 0))?;
        let Envelope { kind, payload, seq } = Envelope::of(&whole).map_err(|error| (error, 0))?;
        let about = |error| (error, seq);
        match kind {
            "hello" => self.hello(payload).map(|reply| Some(message("hello", reply, seq))).map_err(about),
            "episode_start" => self.begin(payload).map(|()| None).map_err(about),
            "observation" => {
                let action = self.act(payload).map_err(about)?;
                Ok(Some(message("action", Value::map([("actions", array(&action))]), seq)))
            }
            "episode_end" | "error" => Ok(None),
            other => {
                let expected = "hello, episode_start, observation, episode_end or error";
                Err(about(ServingError::message("type", expected, shown(other))))
            }
        }
    }

    fn hello(&self, payload: &Value<'_>) -> Result<Value<'static>> {
        if let Some(version) = payload.get("protocol_version").filter(|version| version.count() != Some(VERSION)) {
            return Err(ServingError::message("protocol_version", VERSION.to_string(), version.to_string()));
        }
        // what the runner has to send: states whose quaternions keep their sign, and the hand's camera where it is read
        let mut wanted = vec![("send_state", Value::Bool(true)), ("quat_no_antipodal", Value::Bool(true))];
        let wrist = |key: &str| CAMERAS.iter().any(|(camera, name, _)| (*camera, *name) == ("wrist", key));
        if self.steps.images.iter().any(|(key, ..)| wrist(key)) {
            wanted.push(("send_wrist_image", Value::Bool(true)));
        }
        Ok(Value::map([
            ("harness_version", Value::text(concat!("actrm ", env!("CARGO_PKG_VERSION")))),
            ("protocol_version", integer(VERSION as usize)),
            ("model_server", Value::text(self.steps.name.clone())),
            ("capabilities", Value::map::<&str>([])),
            ("observation_params", Value::map(wanted)),
        ]))
    }

    fn begin(&mut self, payload: &Value<'_>) -> Result<()> {
        let task = payload.get("task");
        let number = |key: &str| task.and_then(|task| task.get(key)).and_then(Value::count);
        let text = |key: &str| match task.and_then(|task| task.get(key)) {
            Some(Value::Text(text)) => Some(text.as_ref()),
            _ => None,
        };
        self.suite = text("suite").unwrap_or_default().to_owned();
        self.task = number("task_id").map(|task| usize::try_from(task).unwrap_or(usize::MAX));
        let mut policy = self.policy()?;
        policy.begin(number("episode_idx").unwrap_or(0), text("name"));
        self.policy = Some(policy);
        Ok(())
    }

    fn policy(&mut self) -> Result<Box<dyn Stepper>> {
        match self.policy.take() {
            Some(policy) => Ok(policy),
            None => (self.steps.policy)().map_err(|reason| ServingError::message("policy", "one", reason)),
        }
    }

    fn act(&mut self, payload: &Value<'_>) -> Result<Vec<f32>> {
        if self.policy.is_none() {
            return Err(ServingError::message("type", "episode_start before the first observation", "none"));
        }
        let all = self.shown(payload)?;
        let policy = self.policy.as_mut().expect("was there");
        let action = policy.act(all).map_err(|reason| ServingError::message("action", "one", reason))?;
        match action.iter().find(|number| !number.is_finite()) {
            Some(other) => Err(ServingError::message("actions", "finite numbers from the policy", other.to_string())),
            None => Ok(action),
        }
    }

    fn shown(&self, payload: &Value<'_>) -> Result<Shown> {
        let mut all = Shown::default();
        for (key, height, width) in &self.steps.images {
            all.images.insert(key.clone(), image(payload, key, *height, *width)?);
        }
        for (key, count) in &self.steps.numbers {
            all.numbers.insert(key.clone(), self.numbers(payload, key, *count)?);
        }
        Ok(all)
    }

    fn numbers(&self, payload: &Value<'_>, key: &str, count: Option<usize>) -> Result<Vec<f64>> {
        if key == TASK {
            let numbered = |ending| SUITES.iter().any(|suite| self.suite.strip_suffix(ending) == Some(suite));
            if !ENDINGS.into_iter().any(numbered) {
                let suites = format!("one of {}, or of these with {}", SUITES.join(", "), ENDINGS[1..].join(", "));
                let expected = format!("a suite that numbers tasks as LIBERO does, {suites}");
                return Err(ServingError::message("suite", expected, shown(&self.suite)));
            }
            let Some((tasks, this)) = count.zip(self.task).filter(|(tasks, task)| task < tasks) else {
                let expected = format!("below {}, the tasks that the policy knows", count.unwrap_or(0));
                let found = self.task.map_or_else(|| "none in episode_start".to_owned(), |task| task.to_string());
                return Err(ServingError::message("task_id", expected, found));
            };
            return Ok((0..tasks).map(|task| f64::from(u8::from(task == this))).collect());
        }
        if !STATE.contains(&key) {
            let known = format!("{}, {TASK} and {}", STATE.join(", "), CAMERAS.map(|(_, name, _)| name).join(", "));
            return Err(ServingError::message(key, format!("a policy that reads no more than {known}"), "its key"));
        }
        let wanted = "8 numbers: position, axis-angle, finger joints (the benchmark's parameter send_state)";
        let Some(state) = payload.get("states").and_then(Value::to_array) else {
            return Err(ServingError::message("states", wanted, format!("no such key in {payload}")));
        };
        // before its numbers are copied
        if state.shape().iter().product::<usize>() != 8 {
            return Err(ServingError::message("states", wanted, format!("{} {:?}", state.dtype(), state.shape())));
        }
        let state: Vec<f64> = state.numbers().into_iter().map(f64::from).collect();
        if let Some(other) = state.iter().find(|number| !number.is_finite()) {
            return Err(ServingError::message("states", wanted, other.to_string()));
        }
        Ok(match key {
            "robot0_eef_pos" | "ee_pos" => state[..3].to_vec(),
            "robot0_eef_quat" => quaternion([state[3], state[4], state[5]]).to_vec(),
            "ee_ori" => state[3..6].to_vec(),
            "ee_states" => state[..6].to_vec(),
            _ => state[6..].to_vec(),
        })
    }
}

/// The quaternion (x, y, z, w) of an axis-angle; angles above pi have a negative w.
fn quaternion(turn: [f64; 3]) -> [f64; 4] {
    let angle = turn.iter().map(|part| part * part).sum::<f64>().sqrt();
    if angle == 0.0 {
        return [0.0, 0.0, 0.0, 1.0];
    }
    let (sine, cosine) = (angle / 2.0).sin_cos();
    let [x, y, z] = turn.map(|part| part / angle * sine);
    [x, y, z, cosine]
}

/// The image of a key of the simulator's: the runner's, turned as the key says and in the policy's size.
fn image(payload: &Value<'_>, key: &str, height: usize, width: usize) -> Result<Vec<u8>> {
    let Some((camera, _, flip)) = CAMERAS.iter().find(|(_, name, _)| *name == key) else {
        let known = CAMERAS.map(|(_, name, _)| name).join(", ");
        return Err(ServingError::message(key, format!("a policy that sees no more than {known}"), "its key"));
    };
    let within = format!("images.{camera}");
    if height != width {
        return Err(ServingError::message(within, "a policy whose images are square", format!("{height} x {width}")));
    }
    let Some(value) = payload.get("images").and_then(|images| images.get(camera)) else {
        return Err(ServingError::message(within, "an image", format!("no such key in {payload}")));
    };
    let (rgb, rows, columns) = pixels(value).map_err(|found| {
        let expected = format!("uint8 (height, width, 3) or a PNG file of that, of at most {MOST_SIDE} pixels a side");
        ServingError::message(within, expected, found)
    })?;
    Ok(resize_with_pad(&flip.of(&rgb, columns), rows, columns, height))
}

/// Pixels with height and width; what was found instead, in words.
fn pixels(value: &Value<'_>) -> std::result::Result<(Vec<u8>, usize, usize), String> {
    if let Value::Array(array) = value {
        return match *array.shape() {
            [rows, columns, 3] if (1..=MOST_SIDE).contains(&rows) && (1..=MOST_SIDE).contains(&columns) => {
                Ok((array.pixels()?, rows, columns))
            }
            _ => Err(format!("{} {:?}", array.dtype(), array.shape())),
        };
    }
    let (Some(Value::Text(format)), Some(Value::Bytes(file))) = (value.get("format"), value.get("data")) else {
        return Err(value.to_string());
    };
    if format != "png" {
        return Err(format!("format {}", shown(format)));
    }
    let broken = |error: png::DecodingError| format!("a PNG file that cannot be read: {error}");
    let limits = png::Limits { bytes: 4 * MOST_SIDE * MOST_SIDE };
    let decoder = png::Decoder::new_with_limits(Cursor::new(file.as_ref()), limits);
    let mut reader = decoder.read_info().map_err(broken)?;
    let info = reader.info();
    let (rows, columns) = (info.height as usize, info.width as usize);
    let plain = (info.color_type, info.bit_depth) == (png::ColorType::Rgb, png::BitDepth::Eight);
    if !plain || rows > MOST_SIDE || columns > MOST_SIDE {
        return Err(format!("{:?} {rows} x {columns}, {:?}", info.color_type, info.bit_depth));
    }
    let mut rgb = vec![0; rows * columns * 3];
    reader.next_frame(&mut rgb).map_err(broken)?;
    Ok((rgb, rows, columns))
}

/// A vector of `float32`, as vla-eval writes arrays: with keys that are texts.
fn array(numbers: &[f32]) -> Value<'static> {
    let data: Vec<u8> = numbers.iter().flat_map(|number| number.to_le_bytes()).collect();
    Value::map([
        ("__ndarray__", Value::Bool(true)),
        ("data", Value::Bytes(data.into())),
        ("dtype", Value::text("<f4")),
        ("shape", Value::List(vec![integer(numbers.len())])),
    ])
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use std::sync::atomic::{AtomicBool, Ordering};
    use std::thread;

    use models::Signature;
    use tungstenite::Message;

    use super::*;
    use crate::server::{Limits, Server};
    use crate::session::Service;

    const WRITTEN: &[u8] = include_bytes!("../fixtures/vla_eval.msgpack");

    /// Its actions are what it was shown: the episode's seed and instruction, the task, the state, each image's first pixel.
    #[derive(Default)]
    struct Echo(f32);

    impl Stepper for Echo {
        fn begin(&mut self, seed: u64, instruction: Option<&str>) {
            self.0 = seed as f32 + if instruction == Some("pick up the soup") { 100.0 } else { 0.0 };
        }

        fn act(&mut self, shown: Shown) -> std::result::Result<Vec<f32>, String> {
            let numbers = [TASK]
                .iter()
                .chain(&STATE)
                .map(|key| shown.numbers[*key].iter().map(|x| *x as f32).collect::<Vec<_>>());
            let images = CAMERAS.map(|(_, key, _)| shown.images[key][..3].iter().map(|x| f32::from(*x)));
            Ok([self.0].into_iter().chain(numbers.into_iter().flatten()).chain(images.into_iter().flatten()).collect())
        }
    }

    fn steps() -> Steps {
        let numbers = [(TASK, Some(4))].into_iter().chain(STATE.map(|key| (key, None)));
        Steps {
            name: "echo@1".to_owned(),
            numbers: numbers.map(|(key, count)| (key.to_owned(), count)).collect(),
            images: CAMERAS.map(|(_, key, _)| (key.to_owned(), 6, 6)).to_vec(),
            policy: Box::new(|| Ok(Box::new(Echo::default()))),
        }
    }

    fn messages<'a>(written: &'a Value<'a>) -> Vec<&'a [u8]> {
        let Some(Value::List(messages)) = written.get("messages") else { panic!("no messages") };
        let bytes = |message: &'a Value<'a>| match message {
            Value::Bytes(bytes) => bytes.as_ref(),
            other => panic!("{other}"),
        };
        messages.iter().map(bytes).collect()
    }

    fn said(answer: &[u8]) -> String {
        let answer = decode(answer).unwrap();
        assert_eq!(answer.get("type"), Some(&Value::text("error")));
        match answer.get("payload").unwrap().get("error") {
            Some(Value::Text(text)) => text.to_string(),
            other => panic!("{other:?}"),
        }
    }

    #[test]
    fn an_episode_of_its_runner_is_shown_as_the_simulator_shows_it() {
        let (written, steps) = (decode(WRITTEN).unwrap(), steps());
        let messages = messages(&written);
        let [hello, start, observed @ .., end] = messages.as_slice() else { panic!("too few") };
        let mut session = Session::new(&steps);
        let answer = session.answer(hello).map_err(|(error, _)| error).unwrap().unwrap();
        let reply = decode(&answer).unwrap();
        assert_eq!((reply.get("type"), reply.get("seq")), (Some(&Value::text("hello")), Some(&Value::Integer(1))));
        let payload = reply.get("payload").unwrap();
        assert_eq!(payload.get("protocol_version"), Some(&Value::Integer(1)));
        for wanted in ["send_state", "send_wrist_image", "quat_no_antipodal"] {
            assert_eq!(payload.get("observation_params").unwrap().get(wanted), Some(&Value::Bool(true)), "{wanted}");
        }
        assert!(session.answer(start).is_ok_and(|answer| answer.is_none()));
        // the last pixel of the first row comes first, or the last of all
        let first = |camera: &str, row: usize| match written.get("pixels").unwrap().get(camera) {
            Some(Value::Bytes(bytes)) => bytes[18 * row + 15..18 * row + 18].iter().map(|x| f32::from(*x)).collect(),
            other => panic!("{other:?}"),
        };
        let seen = [("agentview", 0), ("wrist", 0), ("agentview", 5), ("wrist", 5)];
        let pixels: Vec<f32> = seen.into_iter().flat_map(|(camera, row)| -> Vec<f32> { first(camera, row) }).collect();
        let Some(Value::List(quaternions)) = written.get("quaternions") else { panic!("none") };
        assert_eq!(observed.len(), quaternions.len());
        for (at, (message, quaternion)) in observed.iter().zip(quaternions).enumerate() {
            let answer = session.answer(message).map_err(|(error, _)| error).unwrap().unwrap();
            let answer = decode(&answer).unwrap();
            assert_eq!(answer.get("type"), Some(&Value::text("action")));
            assert_eq!(answer.get("seq"), Some(&Value::Integer(at as i128 + 3)));
            let action = answer.get("payload").unwrap().get("actions").unwrap().to_array().unwrap().numbers();
            let quaternion = quaternion.to_array().unwrap().numbers();
            let length = quaternion.iter().map(|part| part * part).sum::<f32>().sqrt();
            let turn: Vec<f32> = quaternion.iter().map(|part| part / length).collect();
            let (place, fingers) = ([0.1, -0.2, 1.3], [0.02, -0.03]);
            let half = turn[3].clamp(-1.0, 1.0).acos();
            let size = if half == 0.0 { 0.0 } else { 2.0 * half / half.sin() };
            let axis_angle: Vec<f32> = turn[..3].iter().map(|part| part * size).collect();
            let own = [&[105.0, 0.0, 0.0, 1.0, 0.0][..], &place, &turn, &fingers].concat();
            let stored = [&place[..], &axis_angle, &place, &axis_angle, &fingers].concat();
            let expected = [own, stored, pixels.clone()].concat();
            assert_eq!(action.len(), expected.len());
            for (found, expected) in action.iter().zip(&expected) {
                assert!((found - expected).abs() < 1e-6 * expected.abs().max(1.0), "{action:?} {expected:?}");
            }
        }
        assert!(session.answer(end).is_ok_and(|answer| answer.is_none()));
    }

    #[test]
    fn what_cannot_be_answered_is_named() {
        let (written, mut steps) = (decode(WRITTEN).unwrap(), steps());
        let messages = messages(&written);
        let failed = |steps: &Steps, sent: &[&[u8]]| {
            let mut session = Session::new(steps);
            let last = sent.iter().map(|bytes| session.answer(bytes)).last().unwrap();
            last.map_err(|(error, seq)| format!("{seq} {error}")).unwrap_err()
        };
        let one = |kind: &str, payload| message(kind, payload, 7);
        let none = Value::map::<&str>([]);
        assert!(failed(&steps, &[messages[2]]).starts_with("3 type: expected episode_start before"));
        assert!(failed(&steps, &[b"\x93"]).starts_with("0 message: "));
        assert!(failed(&steps, &[&one("bye", none.clone())]).starts_with("7 type: expected hello, "));
        let other = one("hello", Value::map([("protocol_version", Value::Integer(2))]));
        assert_eq!(failed(&steps, &[&other]), "7 protocol_version: expected 1, found 2");
        let blind = one("observation", none);
        assert!(
            failed(&steps, &[messages[1], &blind]).starts_with("7 images.agentview: expected an image, found no such")
        );
        for (format, words) in [("jpeg", "found format jpeg"), ("png", "found a PNG file that cannot be read")] {
            let image = Value::map([("format", Value::text(format)), ("data", Value::Bytes(b"x".into()))]);
            let images = Value::map([("agentview", image.clone()), ("wrist", image)]);
            let seen = one("observation", Value::map([("images", images)]));
            let error = failed(&steps, &[messages[1], &seen]);
            assert!(error.contains(words), "{error}");
        }
        steps.numbers[0].1 = Some(2);
        assert!(failed(&steps, &messages[1..3]).starts_with("3 task_id: expected below 2, the tasks"));
        let other = Value::map([("task", Value::map([("suite", Value::text("libero_object_with_mug"))]))]);
        let other = one("episode_start", other);
        assert!(failed(&steps, &[&other, messages[2]]).starts_with("3 suite: expected a suite that numbers tasks as"));
        steps.numbers[0].0 = "target_pos".to_owned();
        assert!(failed(&steps, &messages[1..3]).starts_with("3 target_pos: expected a policy that reads no more than"));
    }

    #[test]
    fn a_server_speaks_it_under_its_path() {
        let policy = Box::new(|| -> Box<dyn models::Policy> { unreachable!("asked by steps") });
        let signature = Signature { action_dim: 7, ..Signature::default() };
        let service =
            Service { signature, action_horizon: 1, n_action_steps: 1, facts: vec![], policy, steps: Some(steps()) };
        let server = Server::bind("127.0.0.1", 0, None, service, Limits::default()).unwrap();
        let (address, stop) = (server.address(), AtomicBool::new(false));
        thread::scope(|scope| {
            scope.spawn(|| server.run(&|| stop.load(Ordering::SeqCst)));
            let (mut socket, _) = tungstenite::connect(format!("ws://{address}{PATH}")).unwrap();
            let written = decode(WRITTEN).unwrap();
            let messages = messages(&written);
            let mut answers = Vec::new();
            // the last one is no map
            for bytes in [messages[0], messages[1], messages[2], &[0xc0]] {
                socket.send(Message::binary(bytes.to_vec())).unwrap();
                if bytes != messages[1] {
                    answers.push(socket.read().unwrap().into_data());
                }
            }
            let kinds = answers.iter().map(|answer| decode(answer).unwrap().get("type").unwrap().clone());
            assert!(kinds.eq(["hello", "action", "error"].map(Value::text)), "other answers");
            assert!(said(&answers[2]).starts_with("type: expected a message's type, found no such key in nothing"));
            stop.store(true, Ordering::SeqCst);
        });
    }
}
