//! `actrm-zoo serve`, as a client sees it that knows nothing but the protocol, and as `eval --policy` does.

use std::fs;
use std::io::{BufRead, BufReader, Read, Write};
use std::net::TcpStream;
use std::path::Path;
use std::process::{Child, Stdio};

use serde_json::Value;

use e2e::{copied_zoo, listing, refused, root, signal, succeeds, text, zoo};

/// One message of a server's, shorter than 64 KiB.
fn message(stream: &mut impl Read) -> Vec<u8> {
    let mut head = [0; 2];
    stream.read_exact(&mut head).expect("the head of a frame");
    assert_eq!(head[0], 0x82, "a whole binary message");
    let mut length = usize::from(head[1]);
    if length == 126 {
        stream.read_exact(&mut head).expect("its length");
        length = usize::from(u16::from_be_bytes(head));
    }
    let mut message = vec![0; length];
    stream.read_exact(&mut message).expect("the rest of the frame");
    message
}

fn holds(message: &[u8], word: &[u8]) -> bool {
    message.windows(word.len()).any(|part| part == word)
}

/// `lift-act@1` of a zoo, served on a free port, and its address.
fn served(entries: &Path) -> (Child, String) {
    let mut command = zoo(["serve", "lift-act", "--port", "0", "--zoo", text(entries)]);
    command.env_remove("ACTRM_TOKEN").stdout(Stdio::piped()).stderr(Stdio::piped());
    let mut server = command.spawn().expect("it starts");
    let mut said = String::new();
    BufReader::new(server.stdout.take().expect("piped")).read_line(&mut said).expect("text");
    let address = said.trim().strip_prefix("lift-act@1 on ws://").expect("its address").to_owned();
    (server, address)
}

#[test]
fn a_served_policy_is_evaluated_as_its_entry_is() {
    let (_folder, entries) = copied_zoo();
    let (mut server, address) = served(&entries);
    let url = format!("ws://{address}");
    let eval = |subject: &[&str], results: &str| {
        let results = entries.join(results);
        let mut command =
            zoo(["eval", "--max-steps", "12", "--episodes", "3", "--workers", "1", "--zoo", text(&entries)]);
        command.args(["--results", text(&results)]).args(subject).env_remove("ACTRM_TOKEN");
        command
    };
    let outcomes = |results: &str| {
        let folder = entries.join(results);
        let names = listing(&folder);
        fs::read(folder.join(&names[0]).join("outcomes.parquet")).expect("a finished evaluation")
    };
    let mine = ["--policy", &url, "--name", "mine", "--task", "Lift"];
    succeeds(&mut eval(&["lift-act@1"], "own"));
    succeeds(&mut eval(&mine, "served"));
    assert!(outcomes("own") == outcomes("served"), "other outcomes");
    let config = fs::read_to_string(entries.join("mine/1/config.toml")).expect("an entry");
    assert!(config.contains(&url) && config.contains("declared = \"lift-act@1\""), "{config}");

    // what its entry's policy is trained by, as the server says it
    assert!(config.contains("[external.conventions]") && config.contains("horizon = \"16\""), "{config}");
    let results = entries.join("served");
    let rerun = |more: &[&str]| {
        let mut command = zoo(["rerun", "mine@1", "--workers", "1", "--json", "--zoo", text(&entries)]);
        command.args(["--results", text(&results), "--work", text(&entries.join("work"))]).args(more);
        command.env_remove("ACTRM_TOKEN");
        command
    };
    let again: Value = serde_json::from_slice(&succeeds(&mut rerun(&[])).stdout).expect("JSON");
    assert_eq!((&again["same"], &again["reasons"]), (&true.into(), &Value::Array(Vec::new())), "{again}");
    let told = again["steps"].as_array().expect("steps").iter().map(|step| step["told"].to_string());
    assert!(told.collect::<String>().contains("3 of 3 outcomes the same"), "{again}");

    let mapping = entries.join("mapping.toml");
    let one_key = "[[observation]]\nkey = 'observation.state'\nfeature = 'observation.state'\n";
    fs::write(&mapping, one_key).expect("writable");
    for (subject, words) in [
        (vec!["--policy", &url, "--name", "mine"], ["--task", "--protocol"]),
        (vec!["--policy", &url, "--name", "lift-act", "--task", "Lift"], ["no entry with weights", "lift-act@1"]),
        ([&mine[..], &["--mapping", "openpi"]].concat(), ["--mapping openpi", "openpi-libero"]),
        ([&mine[..], &["--mapping", text(&mapping)]].concat(), [&url, "observation.environment_state"]),
    ] {
        refused(&mut eval(&subject, "refused"), &words);
    }
    server.kill().expect("it is ended");
    server.wait().expect("it has ended");
    refused(&mut eval(&[&mine[..], &["--again"]].concat(), "served"), &["policy server", &address, "refused"]);
    refused(&mut rerun(&["--policy", "ws://127.0.0.1:1"]), &["policy server", "ws://127.0.0.1:1"]);
}

#[test]
fn a_shipped_entry_is_served_until_ctrl_c() {
    let shipped = root().join("zoo");
    refused(
        zoo(["serve", "lift-act", "--host", "0.0.0.0", "--zoo", text(&shipped)]).env_remove("ACTRM_TOKEN"),
        &["0.0.0.0:8000", "--token"],
    );
    let (server, address) = served(&shipped);

    let get = |path: &str| {
        let mut stream = TcpStream::connect(&address).expect("it listens");
        write!(stream, "GET {path} HTTP/1.1\r\nHost: {address}\r\n\r\n").expect("sent");
        let mut answer = String::new();
        stream.read_to_string(&mut answer).expect("text");
        answer
    };
    assert!(get("/healthz").starts_with("HTTP/1.1 200 OK\r\n"));

    let mut stream = TcpStream::connect(&address).expect("it listens");
    let upgrade = "Connection: Upgrade\r\nUpgrade: websocket\r\nSec-WebSocket-Version: 13";
    // key and answer of RFC 6455, section 1.3
    let key = "Sec-WebSocket-Key: dGhlIHNhbXBsZSBub25jZQ==";
    write!(stream, "GET / HTTP/1.1\r\nHost: {address}\r\n{upgrade}\r\n{key}\r\n\r\n").expect("sent");
    let mut reader = BufReader::new(stream.try_clone().expect("a second handle"));
    let mut head = String::new();
    while !head.ends_with("\r\n\r\n") {
        assert!(reader.read_line(&mut head).expect("text") > 0, "{head}");
    }
    assert!(head.starts_with("HTTP/1.1 101") && head.contains("s3pPLMBiTxaQ9kYGzzhZRbK+xOo="), "{head}");
    let metadata = message(&mut reader);
    assert!(holds(&metadata, b"lift-act@1") && holds(&metadata, b"robot0_eef_pos"), "{metadata:?}");

    // lists of 9 and 10 zeros; the mask of the frame is 0
    let mut observation = b"\x82\xb1observation.state\x99".to_vec();
    observation.extend([0; 9]);
    observation.extend(b"\xbdobservation.environment_state\x9a");
    observation.extend([0; 10]);
    let mut frame = vec![0x82, 0x80 | observation.len() as u8, 0, 0, 0, 0];
    frame.extend(&observation);
    stream.write_all(&frame).expect("sent");
    let answer = message(&mut reader);
    // 16 actions of 7 numbers
    assert!(holds(&answer, b"actions") && holds(&answer, b"<f4") && holds(&answer, b"\x92\x10\x07"), "{answer:?}");
    assert!(get("/metrics").contains("\nactrm_queries_total 1\n"));

    signal(&server, "INT");
    let output = server.wait_with_output().expect("it ends");
    let error = String::from_utf8_lossy(&output.stderr);
    assert!(output.status.success() && error.contains("stopped after 1 query"), "{}: {error}", output.status);
}
