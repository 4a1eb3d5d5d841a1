//! A serde deserializer over TOML values whose errors are data: which key, what was expected, what is there.
//!
//! `toml`'s own errors are text about a place in one file; after `extends` and overrides there is no such
//! file, but there is always a dotted path.

use std::fmt::{self, Display};

use serde::de::{self, DeserializeOwned, DeserializeSeed, IntoDeserializer, Unexpected};
use serde::forward_to_deserialize_any;
use toml::Value;

use crate::ZooError;

use super::nearest;

/// Why a value was refused, and at which path (outermost key first).
#[derive(Debug)]
struct Refusal {
    path: Vec<String>,
    kind: Kind,
}

#[derive(Debug)]
enum Kind {
    UnknownKey { key: String, alternatives: Vec<String> },
    MissingKey { key: String },
    Invalid { expected: String, found: String },
    Other(String),
}

impl Refusal {
    fn new(kind: Kind) -> Self {
        Self { path: Vec::new(), kind }
    }

    fn under(mut self, key: &str) -> Self {
        self.path.insert(0, key.to_owned());
        self
    }

    fn into_error(mut self, prefix: &[&str]) -> ZooError {
        let path = |mut keys: Vec<String>, last: Option<String>| {
            keys.extend(last);
            let all: Vec<String> = prefix.iter().map(|k| (*k).to_owned()).chain(keys).collect();
            all.join(".")
        };
        let keys = std::mem::take(&mut self.path);
        match self.kind {
            Kind::UnknownKey { key, alternatives } => {
                ZooError::UnknownKey { nearest: nearest(&key, &alternatives), key: path(keys, Some(key)), alternatives }
            }
            Kind::MissingKey { key } => ZooError::MissingKey { key: path(keys, Some(key)) },
            Kind::Invalid { expected, found } => ZooError::InvalidValue { key: path(keys, None), expected, found },
            Kind::Other(text) => {
                ZooError::InvalidValue { key: path(keys, None), expected: "a valid value".to_owned(), found: text }
            }
        }
    }
}

impl Display for Refusal {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{:?} at {}", self.kind, self.path.join("."))
    }
}

impl std::error::Error for Refusal {}

fn owned(names: &[&str]) -> Vec<String> {
    let mut names: Vec<String> = names.iter().map(|n| (*n).to_owned()).collect();
    names.sort();
    names
}

impl de::Error for Refusal {
    fn custom<T: Display>(message: T) -> Self {
        Self::new(Kind::Other(message.to_string()))
    }

    fn invalid_type(found: Unexpected<'_>, expected: &dyn de::Expected) -> Self {
        Self::new(Kind::Invalid { expected: expected.to_string(), found: found.to_string() })
    }

    fn invalid_value(found: Unexpected<'_>, expected: &dyn de::Expected) -> Self {
        Self::invalid_type(found, expected)
    }

    fn invalid_length(found: usize, expected: &dyn de::Expected) -> Self {
        Self::new(Kind::Invalid { expected: expected.to_string(), found: format!("{found} items") })
    }

    fn unknown_field(field: &str, expected: &'static [&'static str]) -> Self {
        Self::new(Kind::UnknownKey { key: field.to_owned(), alternatives: owned(expected) })
    }

    fn unknown_variant(variant: &str, expected: &'static [&'static str]) -> Self {
        Self::new(Kind::Invalid {
            expected: format!("one of {}", owned(expected).join(", ")),
            found: format!("`{variant}`"),
        })
    }

    fn missing_field(field: &'static str) -> Self {
        Self::new(Kind::MissingKey { key: field.to_owned() })
    }
}

/// Reads `value`, which stands at the dotted path `prefix`.
///
/// # Errors
/// [`ZooError::UnknownKey`], [`ZooError::MissingKey`] or [`ZooError::InvalidValue`], each with its path.
pub fn from_value<T: DeserializeOwned>(value: &Value, prefix: &[&str]) -> Result<T, ZooError> {
    T::deserialize(ValueDeserializer(value)).map_err(|refusal| refusal.into_error(prefix))
}

/// [`from_value`] with a seed that knows what is to be read.
///
/// # Errors
/// As [`from_value`].
pub fn from_value_as<S: DeserializeSeed<'static>>(
    seed: S,
    value: &Value,
    prefix: &[&str],
) -> Result<S::Value, ZooError> {
    seed.deserialize(ValueDeserializer(value)).map_err(|refusal| refusal.into_error(prefix))
}

struct ValueDeserializer<'a>(&'a Value);

impl<'de> de::Deserializer<'de> for ValueDeserializer<'_> {
    type Error = Refusal;

    fn deserialize_any<V: de::Visitor<'de>>(self, visitor: V) -> Result<V::Value, Refusal> {
        match self.0 {
            Value::String(text) => visitor.visit_str(text),
            Value::Integer(i) => match u64::try_from(*i) {
                Ok(unsigned) => visitor.visit_u64(unsigned),
                Err(_negative) => visitor.visit_i64(*i),
            },
            Value::Float(x) => visitor.visit_f64(*x),
            Value::Boolean(b) => visitor.visit_bool(*b),
            Value::Datetime(d) => visitor.visit_str(&d.to_string()),
            Value::Array(items) => visitor.visit_seq(Items(items.iter().enumerate())),
            Value::Table(table) => visitor.visit_map(Entries { rest: table.iter(), current: None }),
        }
    }

    fn deserialize_option<V: de::Visitor<'de>>(self, visitor: V) -> Result<V::Value, Refusal> {
        visitor.visit_some(self)
    }

    fn deserialize_newtype_struct<V: de::Visitor<'de>>(
        self,
        _name: &'static str,
        visitor: V,
    ) -> Result<V::Value, Refusal> {
        visitor.visit_newtype_struct(self)
    }

    fn deserialize_enum<V: de::Visitor<'de>>(
        self,
        _name: &'static str,
        variants: &'static [&'static str],
        visitor: V,
    ) -> Result<V::Value, Refusal> {
        match self.0 {
            Value::String(text) => visitor.visit_enum(text.as_str().into_deserializer()),
            Value::Table(table) if table.len() == 1 => {
                let entries = Entries { rest: table.iter(), current: None };
                visitor.visit_enum(de::value::MapAccessDeserializer::new(entries))
            }
            other => Err(Refusal::new(Kind::Invalid {
                expected: format!("one of {}", owned(variants).join(", ")),
                found: other.type_str().to_owned(),
            })),
        }
    }

    forward_to_deserialize_any! {
        bool i8 i16 i32 i64 u8 u16 u32 u64 f32 f64 char str string bytes byte_buf unit unit_struct
        seq tuple tuple_struct map struct identifier ignored_any
    }
}

struct Items<'a>(std::iter::Enumerate<std::slice::Iter<'a, Value>>);

impl<'de> de::SeqAccess<'de> for Items<'_> {
    type Error = Refusal;

    fn next_element_seed<T: de::DeserializeSeed<'de>>(&mut self, seed: T) -> Result<Option<T::Value>, Refusal> {
        let Some((index, value)) = self.0.next() else {
            return Ok(None);
        };
        seed.deserialize(ValueDeserializer(value)).map(Some).map_err(|refusal| refusal.under(&index.to_string()))
    }
}

struct Entries<'a> {
    rest: toml::map::Iter<'a, String, Value>,
    current: Option<(&'a String, &'a Value)>,
}

impl<'de> de::MapAccess<'de> for Entries<'_> {
    type Error = Refusal;

    fn next_key_seed<K: de::DeserializeSeed<'de>>(&mut self, seed: K) -> Result<Option<K::Value>, Refusal> {
        self.current = self.rest.next();
        match self.current {
            Some((key, _)) => seed.deserialize(key.as_str().into_deserializer()).map(Some),
            None => Ok(None),
        }
    }

    fn next_value_seed<T: de::DeserializeSeed<'de>>(&mut self, seed: T) -> Result<T::Value, Refusal> {
        let (key, value) = self.current.take().expect("serde asks for a value only after a key");
        seed.deserialize(ValueDeserializer(value)).map_err(|refusal| refusal.under(key))
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use serde::Deserialize;

    use super::*;

    #[derive(Debug, PartialEq, Deserialize)]
    #[serde(deny_unknown_fields)]
    struct Outer {
        inner: Inner,
        #[serde(default)]
        kind: Option<Kinds>,
    }

    #[derive(Debug, PartialEq, Deserialize)]
    #[serde(deny_unknown_fields)]
    struct Inner {
        steps: u64,
        rate: f64,
        #[serde(default)]
        keys: Vec<String>,
    }

    #[derive(Debug, PartialEq, Deserialize)]
    #[serde(rename_all = "snake_case")]
    enum Kinds {
        MeanStd,
        Identity,
        Points { count: usize },
    }

    fn read(text: &str) -> Result<Outer, ZooError> {
        from_value(&Value::Table(toml::from_str(text).unwrap()), &[])
    }

    #[test]
    fn reads_what_serde_and_toml_agree_on() {
        let outer = read("kind = 'mean_std'\n[inner]\nsteps = 5\nrate = 1\nkeys = ['a']").unwrap();
        assert_eq!(outer.inner.rate, 1.0);
        assert_eq!(outer.kind, Some(Kinds::MeanStd));
        assert_eq!(outer.inner.keys, ["a"]);
        let kind = |text: &str| read(&format!("{text}\n[inner]\nsteps = 5\nrate = 1")).unwrap().kind.unwrap();
        assert_eq!(kind("kind = { points = { count = 3 } }"), Kinds::Points { count: 3 });
        assert_eq!(kind("[kind.points]\ncount = 3"), Kinds::Points { count: 3 });
    }

    #[test]
    fn refusals_carry_the_dotted_path() {
        let message = |text: &str| read(text).unwrap_err().to_string();
        assert_eq!(
            message("[inner]\nstesp = 5\nrate = 1.0"),
            "unknown key `inner.stesp` (did you mean `steps`?); keys here: keys, rate, steps"
        );
        assert_eq!(message("[inner]\nrate = 1.0"), "key `inner.steps` is missing");
        assert_eq!(message("[inner]\nrate = 1.0\nsteps = -1"), "key `inner.steps`: expected u64, found integer `-1`");
        assert_eq!(message("[inner]\nrate = 1.0\nsteps = 'x'"), "key `inner.steps`: expected u64, found string \"x\"");
        assert_eq!(
            message("[inner]\nrate = 1.0\nsteps = 1\nkeys = ['a', 3]"),
            "key `inner.keys.1`: expected a string, found integer `3`"
        );
        assert_eq!(
            message("kind = 'nothing'\n[inner]\nrate = 1.0\nsteps = 1"),
            "key `kind`: expected one of identity, mean_std, points, found `nothing`"
        );
        assert_eq!(
            message("kind = 3\n[inner]\nrate = 1.0\nsteps = 1"),
            "key `kind`: expected one of identity, mean_std, points, found integer"
        );
        let points = |inside: &str| message(&format!("kind = {inside}\n[inner]\nrate = 1.0\nsteps = 1"));
        assert_eq!(
            points("{ pointz = { count = 3 } }"),
            "key `kind`: expected one of identity, mean_std, points, found `pointz`"
        );
        assert_eq!(
            points("{ points = { count = 'x' } }"),
            "key `kind.points.count`: expected usize, found string \"x\""
        );
        assert_eq!(
            points("{ points = {}, identity = {} }"),
            "key `kind`: expected one of identity, mean_std, points, found table"
        );
    }
}
