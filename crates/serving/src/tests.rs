//! The server and the client with each other, and each with something else.

#![allow(clippy::unwrap_used)]

use std::io::{Read, Write};
use std::net::{SocketAddr, TcpListener, TcpStream};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::thread::{self, JoinHandle};
use std::time::Duration;

use models::{ActionChunk, FeatureSpec, ModelError, Observation, Policy, Signature, Values};
use tungstenite::stream::MaybeTlsStream;
use tungstenite::{Message, WebSocket};

use crate::client::{Facts, RemotePolicy};
use crate::codec::{Array, Value, decode, encode};
use crate::error::ServingError;
use crate::mapping::Mapping;
use crate::server::{Limits, Server};
use crate::session::{Service, Session};

const CAMERA: &str = "observation.images.front";

/// Its actions say what it was shown: (sum of the states, brightest pixel), (seed, executed), (queries, observations).
#[derive(Default)]
struct Tells {
    seed: u64,
    executed: usize,
    queries: usize,
    seen: Vec<f32>,
}

impl Policy for Tells {
    fn predict(&mut self, observation: &Observation) -> Result<ActionChunk, ModelError> {
        self.observe(observation);
        let Values::U8(pixels) = observation.require("predict", CAMERA)? else { panic!("numbers") };
        self.queries += 1;
        let brightest = pixels.iter().max().copied().unwrap_or_default();
        let shown = [self.seen.iter().sum(), brightest.into(), self.seed as f32, self.executed as f32];
        let actions = [&shown[..], &[self.queries as f32, self.seen.len() as f32]].concat();
        assert!(actions[0] != 99.0, "a policy that panics");
        let actions = if actions[0] == 98.0 { vec![f32::NAN; 6] } else { actions };
        ActionChunk::new(actions, 3, 2)
    }

    fn observe(&mut self, observation: &Observation) {
        let Some(Values::F32(state)) = observation.get(models::STATE) else { panic!("no state") };
        self.seen.push(state.iter().sum());
    }

    fn executed(&mut self, actions: usize) {
        self.executed += actions;
    }

    fn reset(&mut self, seed: u64) {
        *self = Self { seed, ..Self::default() };
    }
}

fn signature(n_obs_steps: usize) -> Signature {
    let observation = vec![FeatureSpec::state(2), FeatureSpec::image(CAMERA, 2, 4)];
    Signature { observation, n_obs_steps, action_dim: 2, auxiliary_dim: 0 }
}

fn service(n_obs_steps: usize) -> Service {
    let policy = Box::new(|| Box::<Tells>::default() as Box<dyn Policy>);
    let facts = vec![("entry".to_owned(), Value::text("tells@1"))];
    Service { signature: signature(n_obs_steps), action_horizon: 3, n_action_steps: 2, facts, policy, steps: None }
}

/// A server on a thread, which ends with this.
struct Running {
    address: SocketAddr,
    stop: Arc<AtomicBool>,
    thread: Option<JoinHandle<u64>>,
}

impl Running {
    fn new(n_obs_steps: usize, token: Option<&str>, limits: Limits) -> Self {
        Self::at(0, n_obs_steps, token, limits)
    }

    fn at(port: u16, n_obs_steps: usize, token: Option<&str>, limits: Limits) -> Self {
        let server = Server::bind("127.0.0.1", port, token.map(str::to_owned), service(n_obs_steps), limits).unwrap();
        let (address, stop) = (server.address(), Arc::new(AtomicBool::new(false)));
        let flag = Arc::clone(&stop);
        let thread = thread::spawn(move || {
            server.run(&|| flag.load(Ordering::SeqCst));
            server.queries()
        });
        Self { address, stop, thread: Some(thread) }
    }

    fn usual() -> Self {
        Self::new(1, None, Limits::default())
    }

    fn url(&self) -> String {
        format!("ws://{}", self.address)
    }

    fn end(&mut self) -> u64 {
        self.stop.store(true, Ordering::SeqCst);
        self.thread.take().map(|thread| thread.join().unwrap()).unwrap_or_default()
    }
}

impl Drop for Running {
    fn drop(&mut self) {
        self.end();
    }
}

fn observation(state: f32) -> Observation {
    let mut observation = Observation::of_state(vec![state, 0.0], vec![]);
    observation.insert(CAMERA, Values::U8((0..24).collect()));
    observation
}

/// What openpi's client would send of it, with more keys.
fn message(state: f32, more: &[(&'static str, Value<'static>)]) -> Vec<u8> {
    let image = Array::new(crate::codec::Dtype::U8, vec![2, 4, 3], (0..24).collect::<Vec<u8>>()).unwrap();
    let mut pairs = vec![
        ("observation.state", Value::Array(Array::of_f32(vec![2], &[state, 0.0]).unwrap())),
        (CAMERA, Value::Array(image)),
        ("prompt", Value::text("do it")),
    ];
    for (key, value) in more {
        pairs.retain(|(other, _)| other != key);
        pairs.push((key, value.clone()));
    }
    encode(&Value::map(pairs))
}

fn actions(answer: &[u8]) -> Vec<f32> {
    let answer = decode(answer).unwrap();
    assert!(answer.get("server_timing").unwrap().get("infer_ms").is_some());
    let actions = answer.get("actions").unwrap().to_array().unwrap().into_owned();
    assert_eq!((actions.shape(), actions.dtype().to_string().as_str()), (&[3, 2][..], "float32"));
    actions.numbers()
}

type Raw = WebSocket<MaybeTlsStream<TcpStream>>;

/// A client that knows nothing but the protocol.
fn raw(url: &str) -> (Raw, Vec<u8>) {
    let (mut socket, _) = tungstenite::connect(url).unwrap();
    let metadata = socket.read().unwrap().into_data().to_vec();
    (socket, metadata)
}

fn asked(socket: &mut Raw, message: Vec<u8>) -> Result<Vec<f32>, String> {
    socket.send(Message::binary(message)).unwrap();
    loop {
        match socket.read().unwrap() {
            Message::Binary(answer) => return Ok(actions(&answer)),
            Message::Text(error) => return Err(error.to_string()),
            _ => {}
        }
    }
}

fn get(address: SocketAddr, request: &str) -> String {
    let mut stream = TcpStream::connect(address).unwrap();
    stream.write_all(request.as_bytes()).unwrap();
    let mut answer = String::new();
    stream.read_to_string(&mut answer).unwrap();
    answer
}

#[test]
fn a_session_answers_with_the_actions_of_its_policy() {
    let service = service(1);
    let mut session = Session::new(&service);
    let mut ask = |message: Vec<u8>| actions(&session.answer(&message).unwrap());
    assert_eq!(ask(message(1.0, &[])), [1.0, 23.0, 0.0, 0.0, 1.0, 1.0]);
    // as many actions were executed as is usual, or as is said
    assert_eq!(ask(message(2.0, &[])), [3.0, 23.0, 0.0, 2.0, 2.0, 2.0]);
    assert_eq!(ask(message(0.0, &[("executed", Value::Integer(1))])), [3.0, 23.0, 0.0, 3.0, 3.0, 3.0]);
    // an episode begins
    let seed = |seed: u64| ("seed", Value::Integer(seed.into()));
    assert_eq!(ask(message(1.0, &[seed(7)])), [1.0, 23.0, 7.0, 0.0, 1.0, 1.0]);
    assert_eq!(ask(message(1.0, &[("reset", Value::Bool(true))])), [1.0, 23.0, 0.0, 0.0, 1.0, 1.0]);
    assert_eq!(ask(message(1.0, &[("reset", Value::Bool(true)), seed(9)])), [1.0, 23.0, 9.0, 0.0, 1.0, 1.0]);
    assert_eq!(ask(message(1.0, &[("reset", Value::Bool(false))]))[4], 2.0);
    // lists, float64 and images with channels first, as floats
    let list = Value::List(vec![Value::Integer(4), Value::Float(0.5)]);
    let first: Vec<f32> = (0..3).flat_map(|c| (0..8).map(move |at| (3 * at + c) as f32 / 255.0)).collect();
    let first = Value::Array(Array::of_f32(vec![3, 2, 4], &first).unwrap());
    assert_eq!(ask(message(0.0, &[("observation.state", list), (CAMERA, first), seed(0)]))[..2], [4.5, 23.0]);
}

#[test]
fn a_bad_observation_is_named_and_changes_nothing() {
    let service = service(1);
    let mut session = Session::new(&service);
    let f32s =
        |shape: &[usize]| Value::Array(Array::of_f32(shape.to_vec(), &vec![0.5; shape.iter().product()]).unwrap());
    let nan = Value::Array(Array::of_f32(vec![2], &[0.0, f32::NAN]).unwrap());
    for (key, value, words) in [
        ("observation.state", f32s(&[3]), "observation.state: expected float32 [2], found float32 [3]"),
        ("observation.state", f32s(&[2, 2]), "observation.state: expected float32 [2], found float32 [2, 2]"),
        ("observation.state", nan, "observation.state: expected float32 [2], found NaN at 1"),
        ("observation.state", Value::text("x"), "observation.state: expected float32 [2], found a text"),
        (CAMERA, f32s(&[4, 4, 3]), "expected uint8 [2, 4, 3], or float from 0 to 1, found float32 [4, 4, 3]"),
        ("reset", Value::Integer(1), "reset: expected true or false, found 1"),
        ("seed", Value::Integer(-1), "seed: expected an integer from 0 to 18446744073709551615, found -1"),
        ("executed", Value::Integer(4), "executed: expected an integer from 0 to 3, found 4"),
    ] {
        let error = session.answer(&message(1.0, &[(key, value)])).unwrap_err().to_string();
        assert!(error.contains(words), "{error} / {words}");
    }
    let error = session.answer(&encode(&Value::map([("observation/state", Value::Nil)]))).unwrap_err().to_string();
    let expected = "observation.state: expected float32 [2], found no such key in a map of observation/state";
    assert_eq!(error, expected);
    let error = session.answer(&encode(&Value::Integer(1))).unwrap_err().to_string();
    assert_eq!(error, "message: expected a map of observation keys, found 1");
    assert_eq!(actions(&session.answer(&message(1.0, &[])).unwrap())[4], 1.0, "its first query");
    let error = session.answer(&message(97.0, &[])).unwrap_err().to_string();
    assert_eq!(error, "actions: expected finite numbers from the policy, found NaN in action 0");
}

#[test]
fn clients_get_metadata_actions_and_errors_and_each_its_own_episode() {
    let mut running = Running::usual();
    let (mut first, metadata) = raw(&running.url());
    let (mut second, _) = raw(&running.url());
    let metadata = decode(&metadata).unwrap();
    assert_eq!(metadata.get("entry"), Some(&Value::text("tells@1")));
    let camera = metadata.get("observation").unwrap().get(CAMERA).unwrap();
    assert_eq!(camera.get("dtype"), Some(&Value::text("uint8")));
    assert_eq!(camera.get("shape").unwrap().to_array().unwrap().numbers(), [2.0, 4.0, 3.0]);
    assert_eq!(metadata.get("action_horizon"), Some(&Value::Integer(3)));
    assert_eq!(asked(&mut first, message(1.0, &[])).unwrap()[4], 1.0);
    // an error is a text, and the connection stays
    let error = asked(&mut first, message(1.0, &[("observation.state", Value::Nil)])).unwrap_err();
    assert_eq!(error, "observation.state: expected float32 [2], found nothing");
    assert_eq!(asked(&mut first, message(1.0, &[])).unwrap()[4], 2.0);
    assert_eq!(asked(&mut second, message(1.0, &[])).unwrap()[4], 1.0, "an episode of its own");
    // a policy that panics is an error of that query
    let error = asked(&mut second, message(98.0, &[])).unwrap_err();
    assert!(error.starts_with("policy: it failed"), "{error}");
    assert_eq!(asked(&mut second, message(1.0, &[])).unwrap()[4], 1.0);
    let health = get(running.address, "GET /healthz HTTP/1.1\r\nHost: x\r\n\r\n");
    assert!(health.starts_with("HTTP/1.1 200 OK\r\n") && health.ends_with("\r\n\r\nOK\n"), "{health}");
    let metrics = get(running.address, "GET /metrics HTTP/1.1\r\n\r\n");
    assert!(metrics.contains("\nactrm_queries_total 6\n") && metrics.contains("\nactrm_clients 2\n"), "{metrics}");
    assert!(metrics.contains("\nactrm_query_errors_total 2\n"), "{metrics}");
    // both are still connected
    assert_eq!(running.end(), 6);
    assert!(first.read().is_err());
}

#[test]
fn what_is_no_client_is_refused() {
    let running = Running::new(1, None, Limits { clients: 1, ..Limits::default() });
    for (request, status) in [
        ("GET / HTTP/1.1\r\n\r\n", "426 "),
        ("POST /healthz HTTP/1.1\r\n\r\n", "405 "),
        ("nonsense\r\n\r\n", "400 "),
        ("GET /metrics HTTP/1.1\r\nOrigin: https://example.org\r\n\r\n", "401 "),
    ] {
        let answer = get(running.address, request);
        assert!(answer.starts_with(&format!("HTTP/1.1 {status}")), "{request}: {answer}");
    }
    let long = format!("GET / HTTP/1.1\r\nX: {}", "x".repeat(20_000));
    assert!(get(running.address, &long).starts_with("HTTP/1.1 431 "));
    let (_first, _) = raw(&running.url());
    let error =
        RemotePolicy::connect(&running.url(), None, &signature(1), &Mapping::default()).unwrap_err().to_string();
    assert!(error.contains("503") && error.contains("at most 1 clients"), "{error}");
}

#[test]
fn a_token_is_needed_where_others_can_reach_it() {
    let bind = |host: &str, token: Option<&str>| {
        Server::bind(host, 0, token.map(str::to_owned), service(1), Limits::default()).map(drop)
    };
    assert!(bind("localhost", None).is_ok() && bind("0.0.0.0", Some("secret")).is_ok());
    assert!(matches!(bind("0.0.0.0", None), Err(ServingError::Unprotected { .. })));
    assert!(matches!(bind("127.0.0.1", Some("")), Err(ServingError::Token { .. })));
    assert!(matches!(bind("127.0.0.1", Some("a b")), Err(ServingError::Token { .. })));
    let running = Running::new(1, Some("secret"), Limits::default());
    let connect = |token| RemotePolicy::connect(&running.url(), token, &signature(1), &Mapping::default());
    for token in [None, Some("secre"), Some("secret1"), Some("Secret")] {
        let error = connect(token).unwrap_err().to_string();
        assert!(error.contains("401") && error.contains("Api-Key"), "{error}");
    }
    assert_eq!(connect(Some("secret")).unwrap().predict(&observation(1.0)).unwrap().actions[0], 1.0);
    assert!(get(running.address, "GET /metrics HTTP/1.1\r\n\r\n").starts_with("HTTP/1.1 401 "));
    assert!(get(running.address, "GET /healthz HTTP/1.1\r\n\r\n").starts_with("HTTP/1.1 200 "));
}

#[test]
fn a_remote_policy_is_the_policy() {
    for n_obs_steps in [1, 3] {
        let running = Running::new(n_obs_steps, None, Limits::default());
        let mut remote =
            RemotePolicy::connect(&running.url(), None, &signature(n_obs_steps), &Mapping::default()).unwrap();
        assert_eq!(remote.n_obs_steps(), n_obs_steps);
        let mut local = Tells::default();
        for seed in [5, 6] {
            remote.reset(seed);
            local.reset(seed);
            for query in 0..4_u8 {
                let (asked, shown) = (observation(query.into()), observation(10.0));
                assert_eq!(remote.predict(&asked).unwrap(), local.predict(&asked).unwrap());
                let executed = usize::from(query % 3);
                remote.executed(executed);
                local.executed(executed);
                // what is needed of the steps between
                for _ in 1..n_obs_steps {
                    remote.observe(&shown);
                    local.observe(&shown);
                }
            }
        }
    }
}

#[test]
fn a_lost_connection_is_made_again_at_the_same_place_of_the_episode() {
    let mut running = Running::usual();
    let mut remote = RemotePolicy::connect(&running.url(), None, &signature(1), &Mapping::default()).unwrap();
    remote.pause = Duration::from_millis(50);
    let mut local = Tells::default();
    remote.reset(3);
    local.reset(3);
    for query in 0..6_u8 {
        if query % 2 == 1 {
            running.end();
            running = Running::at(running.address.port(), 1, None, Limits::default());
        }
        let asked = observation(query.into());
        assert_eq!(remote.predict(&asked).unwrap(), local.predict(&asked).unwrap(), "query {query}");
        remote.executed(1);
        local.executed(1);
    }
    let url = running.url();
    running.end();
    remote.pause = Duration::from_millis(1);
    let error = remote.predict(&observation(1.0)).unwrap_err().to_string();
    assert!(error.contains(&url) && error.contains("tried 4 times"), "{error}");
    // another server at its address
    let other = Running::at(running.address.port(), 3, None, Limits::default());
    let error = remote.predict(&observation(1.0)).unwrap_err().to_string();
    assert!(error.contains("the server reports other metadata for "), "{error}");
    let again = RemotePolicy::connect(&other.url(), None, &signature(3), &Mapping::default()).unwrap();
    let before = Facts::ask(&other.url(), None, &Mapping::default()).unwrap();
    assert!(again.as_asked(&before).is_ok_and(|policy| policy.as_asked(&Facts::default()).is_err()));
}

/// A server that sends this metadata and then answers each message with the next of these, and then nothing more.
fn scripted(metadata: Value<'static>, answers: Vec<Message>) -> String {
    let listener = TcpListener::bind("127.0.0.1:0").unwrap();
    let url = format!("ws://{}", listener.local_addr().unwrap());
    thread::spawn(move || {
        let mut socket = tungstenite::accept(listener.accept().unwrap().0).unwrap();
        socket.send(Message::binary(encode(&metadata))).unwrap();
        for answer in answers {
            socket.read().unwrap();
            if socket.send(answer).is_err() {
                return;
            }
        }
        // until the client has gone
        while socket.read().is_ok() {}
    });
    url
}

#[test]
fn a_prompt_is_what_the_environment_says_or_the_tasks_name() {
    let listener = TcpListener::bind("127.0.0.1:0").unwrap();
    let url = format!("ws://{}", listener.local_addr().unwrap());
    let server = thread::spawn(move || {
        let mut socket = tungstenite::accept(listener.accept().unwrap().0).unwrap();
        socket.send(Message::binary(encode(&empty()))).unwrap();
        let mut prompts = Vec::new();
        let end = loop {
            let query = match socket.read() {
                Ok(Message::Binary(query)) => query,
                end => break end,
            };
            let Some(Value::Text(prompt)) = decode(&query).unwrap().get("prompt").cloned() else { panic!("no prompt") };
            prompts.push(prompt.to_string());
            let actions = Value::Array(Array::of_f32(vec![1, 2], &[0.0, 0.0]).unwrap());
            socket.send(Message::binary(encode(&Value::map([("actions", actions)])))).unwrap();
        };
        assert!(matches!(end, Ok(Message::Close(_))), "{end:?}");
        prompts
    });
    let mapping = Mapping::parse("m", "prompt = '{instruction} ({task})'").unwrap().of_task("Lift");
    let mut remote = RemotePolicy::connect(&url, None, &signature(1), &mapping).unwrap();
    for instruction in [Some("lift the cube"), None] {
        remote.reset(1);
        remote.instruct(instruction);
        remote.predict(&observation(1.0)).unwrap();
    }
    // an episode of which nothing is said
    remote.instruct(Some("lift the cube"));
    remote.reset(2);
    remote.predict(&observation(1.0)).unwrap();
    drop(remote);
    assert_eq!(server.join().unwrap(), ["lift the cube (Lift)", "Lift (Lift)", "Lift (Lift)"]);
}

fn empty() -> Value<'static> {
    Value::Map(Vec::new())
}

fn connect(url: &str) -> Result<RemotePolicy, ServingError> {
    let mapping = Mapping { timeout_s: 1, ..Mapping::default() };
    let mut remote = RemotePolicy::connect(url, None, &signature(1), &mapping)?;
    remote.pause = Duration::from_millis(1);
    Ok(remote)
}

#[test]
fn answers_that_are_none_are_named() {
    let answer = |actions: Value<'static>| Message::binary(encode(&Value::map([("actions", actions)])));
    let array = |shape: &[usize], values: &[f32]| answer(Value::Array(Array::of_f32(shape.to_vec(), values).unwrap()));
    let cases = [
        (array(&[2], &[0.0, 0.0]), "expected an array of numbers (T, 2), found float32 [2]"),
        (array(&[1, 3], &[0.0; 3]), "found float32 [1, 3]"),
        (array(&[0, 2], &[]), "found float32 [0, 2]"),
        (array(&[1, 2], &[0.0, f32::NAN]), "actions: expected finite numbers, found NaN in action 0"),
        (array(&[2, 2], &[0.0, 0.0, f32::INFINITY, 0.0]), "found inf in action 1"),
        (answer(Value::text("x")), "actions: expected an array of numbers (T, 2), found a text"),
        (Message::binary(encode(&empty())), "found no such key in a map of nothing"),
        (Message::binary(vec![0xc1, 0, 1]), "its answer: message: expected plain MessagePack"),
        (
            Message::text("Traceback:\n  File x\nValueError: no state\n"),
            "it answered with an error: ValueError: no state",
        ),
        (Message::binary(vec![0; 65 << 20]), "its answer is too large, expected at most 67108864 bytes"),
    ];
    for (answer, words) in cases {
        let url = scripted(empty(), vec![answer]);
        let error = connect(&url).unwrap().predict(&observation(1.0)).unwrap_err().to_string();
        assert!(error.starts_with(&format!("policy server {url}: ")) && error.contains(words), "{error} / {words}");
    }
    // a plain list of lists and further keys are fine
    let list = Value::List(vec![Value::List(vec![Value::Integer(1), Value::Float(0.5)])]);
    let url = scripted(empty(), vec![answer(list)]);
    assert_eq!(connect(&url).unwrap().predict(&observation(1.0)).unwrap().actions, [1.0, 0.5]);
}

#[test]
fn a_server_that_hangs_ends_the_query_at_its_limit() {
    let url = scripted(empty(), vec![]);
    let error = connect(&url).unwrap().predict(&observation(1.0)).unwrap_err().to_string();
    assert!(error.contains(&url) && error.contains("no answer within 1 s"), "{error}");
    // one that never says what it is
    let listener = TcpListener::bind("127.0.0.1:0").unwrap();
    let error = connect(&format!("ws://{}", listener.local_addr().unwrap())).unwrap_err().to_string();
    assert!(error.contains("no answer within 1 s"), "{error}");
    assert!(connect("wss://x:1").unwrap_err().to_string().contains("expected ws://host:port"));
    assert!(connect("ws://127.0.0.1:1").unwrap_err().to_string().contains("cannot connect"));
}

#[test]
fn what_a_server_says_of_itself_is_compared() {
    let feature = |shape: &[i128]| {
        let extents = shape.iter().map(|extent| Value::Integer(*extent)).collect();
        Value::map([("shape", Value::List(extents))])
    };
    for (metadata, words) in [
        (
            ("observation", Value::map([("observation.state", feature(&[3]))])),
            "observation.state: expected [2], which is sent, found [3]",
        ),
        (
            ("observation", Value::map([("gripper", feature(&[1]))])),
            "gripper: expected a key that is sent, found observation.state, ",
        ),
        (("action_dim", Value::Integer(7)), "action_dim: expected 2, found 7"),
        (("n_obs_steps", Value::Integer(0)), "n_obs_steps: expected an integer from 1 on, found 0"),
        (("n_obs_steps", Value::Integer(1 << 40)), "n_obs_steps: expected at most 1000"),
    ] {
        let error = connect(&scripted(Value::map([metadata]), vec![])).unwrap_err().to_string();
        assert!(error.contains("its metadata: ") && error.contains(words), "{error} / {words}");
    }
    let mut remote = connect(&scripted(Value::map([("max_message_bytes", Value::Integer(50))]), vec![])).unwrap();
    let error = remote.predict(&observation(1.0)).unwrap_err().to_string();
    assert!(error.contains("expected at most 50, as the server says"), "{error}");
}

#[test]
fn a_message_above_the_limit_is_refused_and_the_server_goes_on() {
    let running = Running::new(1, None, Limits { message: 1000, ..Limits::default() });
    let (mut socket, _) = raw(&running.url());
    // the client may be told while it is still sending
    let _ = socket.send(Message::binary(vec![0; 5 << 20]));
    let Message::Text(error) = socket.read().unwrap() else { panic!("no text") };
    assert!(error.starts_with("message: expected at most 1000 bytes, found "), "{error}");
    assert!(matches!(socket.read().unwrap(), Message::Close(Some(frame)) if u16::from(frame.code) == 1009));
    let (mut socket, _) = raw(&running.url());
    assert_eq!(asked(&mut socket, message(1.0, &[])).unwrap()[0], 1.0);
}

#[test]
fn mutated_messages_and_bytes_leave_the_server_as_it_was() {
    let running = Running::usual();
    let (mut socket, _) = raw(&running.url());
    let usual = message(1.0, &[]);
    for at in 0..usual.len() {
        let mut mutated = usual.clone();
        mutated[at] ^= 1 << (at % 8);
        // an answer or an error, on the same connection
        let _ = asked(&mut socket, mutated);
    }
    for at in 0..200_usize {
        let mut stream = TcpStream::connect(running.address).unwrap();
        let garbage: Vec<u8> = (0..at).map(|byte| (byte * 37 + at * 101) as u8).collect();
        stream.write_all(&garbage).unwrap();
    }
    assert_eq!(asked(&mut socket, message(1.0, &[("reset", Value::Bool(true))])).unwrap()[..2], [1.0, 23.0]);
}
