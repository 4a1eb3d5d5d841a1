//! An ONNX model as bytes: the few messages of `onnx.proto` that a feed-forward network needs, in protobuf's wire format.

/// Form of the file, and version of its operators.
const IR_VERSION: u64 = 8;
const OPSET: u64 = 17;
/// Numbers of `TensorProto.DataType`.
const FLOAT: u64 = 1;
const INT64: u64 = 7;

/// A message under construction.
#[derive(Debug, Default)]
struct Message(Vec<u8>);

impl Message {
    fn varint(&mut self, mut value: u64) {
        while value >= 0x80 {
            self.0.push(value as u8 | 0x80);
            value >>= 7;
        }
        self.0.push(value as u8);
    }

    fn int(mut self, field: u64, value: u64) -> Self {
        self.varint(field << 3);
        self.varint(value);
        self
    }

    fn float(mut self, field: u64, value: f32) -> Self {
        self.varint(field << 3 | 5);
        self.0.extend(value.to_le_bytes());
        self
    }

    fn bytes(mut self, field: u64, value: &[u8]) -> Self {
        self.varint(field << 3 | 2);
        self.varint(value.len() as u64);
        self.0.extend(value);
        self
    }

    fn text(self, field: u64, value: &str) -> Self {
        self.bytes(field, value.as_bytes())
    }

    fn message(self, field: u64, value: Self) -> Self {
        self.bytes(field, &value.0)
    }
}

/// An attribute of an operator.
pub(super) enum Attribute {
    Int(&'static str, i64),
    Ints(&'static str, Vec<i64>),
    Float(&'static str, f32),
}

impl Attribute {
    fn message(&self) -> Message {
        /// Numbers of `AttributeProto.AttributeType`.
        const FLOAT: u64 = 1;
        const INT: u64 = 2;
        const INTS: u64 = 7;
        match self {
            Self::Float(name, value) => Message::default().text(1, name).float(2, *value).int(20, FLOAT),
            // negative numbers are sign-extended
            Self::Int(name, value) => Message::default().text(1, name).int(3, *value as u64).int(20, INT),
            Self::Ints(name, values) => values
                .iter()
                .fold(Message::default().text(1, name), |message, value| message.int(8, *value as u64))
                .int(20, INTS),
        }
    }
}

/// A length of an axis: fixed, or by name.
pub(super) enum Extent {
    Fixed(usize),
    Named(&'static str),
}

/// A graph under construction. Values are named as they are made.
#[derive(Debug, Default)]
pub(super) struct Graph {
    nodes: Vec<Message>,
    constants: Vec<Message>,
    inputs: Vec<Message>,
    outputs: Vec<Message>,
}

impl Graph {
    /// A constant of numbers.
    pub fn floats(&mut self, name: &str, dims: &[usize], values: &[f32]) -> String {
        debug_assert_eq!(dims.iter().product::<usize>(), values.len());
        self.constant(name, FLOAT, dims, values.iter().flat_map(|value| value.to_le_bytes()).collect())
    }

    /// A list of integers.
    pub fn ints(&mut self, values: &[i64]) -> String {
        let name = format!("constant_{}", self.constants.len());
        self.constant(&name, INT64, &[values.len()], values.iter().flat_map(|value| value.to_le_bytes()).collect())
    }

    fn constant(&mut self, name: &str, kind: u64, dims: &[usize], data: Vec<u8>) -> String {
        let message = dims.iter().fold(Message::default(), |message, dim| message.int(1, *dim as u64));
        self.constants.push(message.int(2, kind).text(8, name).bytes(9, &data));
        name.to_owned()
    }

    /// The result of an operator.
    pub fn node(&mut self, operator: &str, inputs: &[&str], attributes: &[Attribute]) -> String {
        let name = format!("{}_{}", operator.to_lowercase(), self.nodes.len());
        self.named(operator, inputs, attributes, &name);
        name
    }

    /// The same under a name of its own.
    pub fn named(&mut self, operator: &str, inputs: &[&str], attributes: &[Attribute], name: &str) {
        let message = inputs.iter().fold(Message::default(), |message, input| message.text(1, input));
        let message = message.text(2, name).text(3, name).text(4, operator);
        let message = attributes.iter().fold(message, |message, attribute| message.message(5, attribute.message()));
        self.nodes.push(message);
    }

    /// An input of 32-bit numbers.
    pub fn input(&mut self, name: &str, shape: &[Extent]) {
        self.inputs.push(value(name, shape));
    }

    /// The value `name` as an output.
    pub fn output(&mut self, name: &str, shape: &[Extent]) {
        self.outputs.push(value(name, shape));
    }

    /// The file. `about` is kept as its metadata.
    pub fn into_model(self, name: &str, about: &[(String, String)]) -> Vec<u8> {
        let graph = |message: Message, field: u64, all: Vec<Message>| {
            all.into_iter().fold(message, |message, one| message.message(field, one))
        };
        let body = graph(Message::default(), 1, self.nodes).text(2, name);
        let body = graph(body, 5, self.constants);
        let body = graph(graph(body, 11, self.inputs), 12, self.outputs);
        let operators = Message::default().text(1, "").int(2, OPSET);
        let model = Message::default().int(1, IR_VERSION).text(2, "actrm").text(3, env!("CARGO_PKG_VERSION"));
        let model = model.message(7, body).message(8, operators);
        let entries = about.iter().map(|(key, value)| Message::default().text(1, key).text(2, value));
        entries.fold(model, |model, entry| model.message(14, entry)).0
    }
}

fn value(name: &str, shape: &[Extent]) -> Message {
    let dims = shape.iter().map(|extent| match extent {
        Extent::Fixed(length) => Message::default().int(1, *length as u64),
        Extent::Named(name) => Message::default().text(2, name),
    });
    let shape = dims.fold(Message::default(), |shape, dim| shape.message(1, dim));
    let tensor = Message::default().int(1, FLOAT).message(2, shape);
    Message::default().text(1, name).message(2, Message::default().message(1, tensor))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn fields_are_as_protobuf_writes_them() {
        // of the protobuf documentation: field 1 is 150; field 2 is "testing"
        assert_eq!(Message::default().int(1, 150).0, [0x08, 0x96, 0x01]);
        assert_eq!(Message::default().text(2, "testing").0, [0x12, 7, b't', b'e', b's', b't', b'i', b'n', b'g']);
        assert_eq!(Message::default().int(3, -1_i64 as u64).0.len(), 11);
        assert_eq!(Message::default().float(2, 1.0).0, [0x15, 0, 0, 0x80, 0x3f]);
        let inner = Message::default().message(3, Message::default().int(1, 150));
        assert_eq!(inner.0, [0x1a, 3, 0x08, 0x96, 0x01]);
    }
}
