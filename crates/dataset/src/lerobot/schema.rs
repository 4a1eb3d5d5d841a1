//! Arrow and Parquet schemas of the data files, and the metadata that Hugging Face's `datasets` reads.

use super::info::{Feature, Features};
use arrow_schema::{DataType, Field, Fields, Schema, SchemaRef};
use parquet::arrow::{ArrowSchemaConverter, add_encoded_arrow_schema_to_metadata};
use parquet::basic::{Compression, Encoding, Type as PhysicalType, ZstdLevel};
use parquet::errors::Result as ParquetResult;
use parquet::file::metadata::KeyValue;
use parquet::file::properties::{EnabledStatistics, WriterProperties};
use serde_json::{Map, Value, json};
use sha2::{Digest, Sha256};
use std::sync::Arc;

/// Name and version that Parquet files carry.
pub(crate) const CREATED_BY: &str = concat!("actrm ", env!("CARGO_PKG_VERSION"));

/// The Arrow schema of the data files. `datasets` takes a column for images only if it may be null, as those that it writes.
pub(crate) fn data_schema(features: &Features) -> SchemaRef {
    let fields: Fields =
        in_files(features).map(|(name, f)| Field::new(name, data_type(f), f.dtype == "image")).collect();
    Arc::new(Schema::new(fields))
}

/// The columns that data files have: videos lie beside them.
fn in_files(features: &Features) -> impl Iterator<Item = &(String, Feature)> {
    features.0.iter().filter(|(_, f)| f.dtype != "video")
}

fn data_type(feature: &Feature) -> DataType {
    let value = match feature.dtype.as_str() {
        "image" => return DataType::Struct(image_fields()),
        "int64" => DataType::Int64,
        "float64" => DataType::Float64,
        "bool" => DataType::Boolean,
        _ => DataType::Float32,
    };
    match feature.dim() {
        1 => value,
        n => DataType::FixedSizeList(element(value), n as i32),
    }
}

/// The child of a list column.
pub(crate) fn element(value: DataType) -> Arc<Field> {
    Arc::new(Field::new("element", value, false))
}

/// An image column is a struct of the encoded file and its name.
pub(crate) fn image_fields() -> Fields {
    Fields::from(vec![Field::new("bytes", DataType::Binary, true), Field::new("path", DataType::Utf8, true)])
}

/// The `huggingface` entry of a data file.
pub(crate) fn huggingface_metadata(features: &Features) -> KeyValue {
    let mut map = Map::new();
    for (name, f) in in_files(features) {
        let value = json!({"dtype": f.dtype, "_type": "Value"});
        let described = match (f.dtype.as_str(), f.dim()) {
            ("image", _) => json!({"_type": "Image"}),
            (_, 1) => value,
            (_, n) => json!({"feature": value, "length": n, "_type": "List"}),
        };
        map.insert(name.clone(), described);
    }
    described_as(map)
}

/// The entry that says this of the columns.
pub(crate) fn described_as(columns: Map<String, Value>) -> KeyValue {
    let features = Value::Object(columns);
    let digest: [u8; 32] = Sha256::digest(features.to_string()).into();
    let fingerprint = &hex(&digest)[..16];
    let text = json!({"info": {"features": features}, "fingerprint": fingerprint}).to_string();
    KeyValue::new("huggingface".to_owned(), text)
}

/// Lower-case hexadecimal.
pub(crate) fn hex(bytes: &[u8]) -> String {
    const DIGITS: &[u8; 16] = b"0123456789abcdef";
    let mut text = String::with_capacity(2 * bytes.len());
    for byte in bytes {
        text.push(char::from(DIGITS[usize::from(byte >> 4)]));
        text.push(char::from(DIGITS[usize::from(byte & 15)]));
    }
    text
}

/// Writer properties for `schema`: zstd throughout; floats with their bytes split into streams, which
/// compresses them best and fastest; integers as differences; row-group statistics for scalar columns only.
pub(crate) fn writer_properties(schema: &Schema, metadata: Vec<KeyValue>) -> ParquetResult<WriterProperties> {
    let descriptor = ArrowSchemaConverter::new().convert(schema)?;
    // pyarrow reads a file's metadata from the Arrow schema where there is one, and looks nowhere else
    let pairs = metadata.iter().filter_map(|pair| Some((pair.key.clone(), pair.value.clone()?)));
    let described = schema.clone().with_metadata(pairs.collect::<std::collections::HashMap<_, _>>());
    let mut builder = WriterProperties::builder()
        .set_created_by(CREATED_BY.to_owned())
        .set_compression(Compression::ZSTD(ZstdLevel::try_new(1)?))
        .set_dictionary_enabled(false)
        .set_statistics_enabled(EnabledStatistics::None)
        .set_key_value_metadata((!metadata.is_empty()).then_some(metadata));
    for column in descriptor.columns() {
        let path = column.path().clone();
        if column.max_rep_level() == 0 && column.physical_type() != PhysicalType::BYTE_ARRAY {
            builder = builder.set_column_statistics_enabled(path.clone(), EnabledStatistics::Chunk);
        }
        let encoding = match column.physical_type() {
            PhysicalType::FLOAT | PhysicalType::DOUBLE => Encoding::BYTE_STREAM_SPLIT,
            PhysicalType::INT64 | PhysicalType::INT32 => Encoding::DELTA_BINARY_PACKED,
            _ => Encoding::PLAIN,
        };
        builder = builder.set_column_encoding(path, encoding);
    }
    let mut properties = builder.build();
    add_encoded_arrow_schema_to_metadata(&described, &mut properties);
    Ok(properties)
}
