//! A sound data set, and how its files are edited.

#![allow(clippy::unwrap_used)]

use crate::common::going;
use arrow_array::builder::{ListBuilder, StringBuilder};
use arrow_array::cast::AsArray;
use arrow_array::types::{Float32Type, Float64Type, Int64Type};
use arrow_array::{Array as _, ArrayRef, Float32Array, Float64Array, Int64Array, RecordBatch, StringArray};
use arrow_cast::cast;
use arrow_schema::{DataType, Field};
use arrow_select::concat::concat_batches;
use arrow_select::take::take_record_batch;
use dataset::edit::{Destination, Selection, keep};
use dataset::{Array, Check, ConvertOptions, Demo, RobomimicWriter, WriteOptions, convert};
use parquet::arrow::ArrowWriter;
use parquet::arrow::arrow_reader::ParquetRecordBatchReaderBuilder;
use parquet::file::properties::WriterProperties;
use serde_json::Value;
use std::fs::File;
use std::path::Path;
use std::sync::Arc;

pub const DATA: &str = "data/chunk-000/file-000.parquet";
pub const LATER: &str = "data/chunk-000/file-001.parquet";
pub const EPISODES: &str = "meta/episodes/chunk-000/file-000.parquet";
pub const TASKS: &str = "meta/tasks.parquet";
pub const INFO: &str = "meta/info.json";
pub const STATS: &str = "meta/stats.json";
pub const DEMOS: usize = 12;
pub const FRAMES: usize = 40;

pub fn quiet(_: u64, _: u64) {}

/// Numbers from -1 to 1 that do not compress.
pub fn noise(i: usize) -> f64 {
    let mut x = (i as u64 + 1).wrapping_mul(0x9E37_79B9_7F4A_7C15);
    x = (x ^ (x >> 30)).wrapping_mul(0xBF58_476D_1CE4_E5B9);
    x = (x ^ (x >> 27)).wrapping_mul(0x94D0_49BB_1331_11EB);
    (x >> 11) as f64 / (1_u64 << 52) as f64 - 1.0
}

/// Twelve demos of three tasks, four in each of three files.
pub fn sound(out: &Path) {
    let file = out.with_extension("hdf5");
    let mut writer = RobomimicWriter::create(&file, &WriteOptions::default()).unwrap();
    writer.set_root(&Demo::default()).unwrap();
    for number in 0..DEMOS {
        let mut demo = Demo { id: format!("demo_{number}"), ..Demo::default() };
        demo.attrs.insert("num_samples".to_owned(), Array::from_i64(vec![], &[FRAMES as i64]));
        demo.attrs.insert("ep_meta".to_owned(), Array::from_str(&format!("{{\"lang\": \"task {}\"}}", number % 3)));
        for (key, width) in [("robot0_eef_pos", 3), ("robot0_eef_quat", 4), ("robot0_gripper_qpos", 2), ("object", 4)] {
            let values: Vec<f64> = (0..FRAMES * width).map(|i| noise(1000 * (number + 20 * width) + i)).collect();
            demo.datasets.insert(format!("obs/{key}"), Array::from_f64(vec![FRAMES, width], &values));
        }
        let actions: Vec<f64> = (0..FRAMES * 7).map(|i| noise(1000 * number + i)).collect();
        demo.datasets.insert("actions".to_owned(), Array::from_f64(vec![FRAMES, 7], &actions));
        let rewards: Vec<f64> = (0..FRAMES).map(|i| f64::from(i + 1 == FRAMES)).collect();
        demo.datasets.insert("rewards".to_owned(), Array::from_f64(vec![FRAMES], &rewards));
        demo.datasets.insert("dones".to_owned(), Array::from_f64(vec![FRAMES], &rewards));
        writer.add_demo(&demo).unwrap();
    }
    writer.finish().unwrap();
    // a file for each row group of four demos; of files as edits write them, so that repairs write the same bytes
    for thousandths in 15..40 {
        let data_file_mb = f64::from(thousandths) * 1e-3;
        let options = ConvertOptions { fps: Some(20.0), data_file_mb, ..ConvertOptions::default() };
        let whole = out.with_extension("converted");
        convert(&file, &whole, &options, &mut quiet).unwrap();
        keep(&whole, &Destination::New(out.to_owned()), &numbers(0..DEMOS), &mut going).unwrap();
        let episodes = read_table(&out.join(EPISODES));
        let files = episodes.column_by_name("data/file_index").unwrap().as_primitive::<Int64Type>().values().to_vec();
        std::fs::remove_dir_all(whole).unwrap();
        if files == [0, 0, 0, 0, 1, 1, 1, 1, 2, 2, 2, 2] {
            return;
        }
        std::fs::remove_dir_all(out).unwrap();
    }
    panic!("no size of files has four demos in each");
}

pub fn numbers(episodes: std::ops::Range<usize>) -> Selection {
    Selection { episodes: episodes.collect(), ..Selection::default() }
}

pub fn edit_json(root: &Path, file: &str, edit: impl Fn(&mut Value)) {
    let path = root.join(file);
    let mut value: Value = serde_json::from_slice(&std::fs::read(&path).unwrap()).unwrap();
    edit(&mut value);
    std::fs::write(path, serde_json::to_vec_pretty(&value).unwrap()).unwrap();
}

/// Edits a JSON file whose keys keep their order.
pub fn edit_text(root: &Path, file: &str, old: &str, new: &str) {
    let text = std::fs::read_to_string(root.join(file)).unwrap();
    assert!(text.contains(old), "{text}");
    std::fs::write(root.join(file), text.replace(old, new)).unwrap();
}

pub fn read_table(path: &Path) -> RecordBatch {
    let reader = ParquetRecordBatchReaderBuilder::try_new(File::open(path).unwrap()).unwrap().build().unwrap();
    let batches: Vec<RecordBatch> = reader.map(Result::unwrap).collect();
    concat_batches(&batches[0].schema(), &batches).unwrap()
}

pub fn edit_table(root: &Path, file: &str, edit: impl Fn(RecordBatch) -> RecordBatch) {
    let path = root.join(file);
    let table = edit(read_table(&path));
    // what is said to Hugging Face's `datasets` stays
    let reader = ParquetRecordBatchReaderBuilder::try_new(File::open(&path).unwrap()).unwrap();
    let mut said = reader.metadata().file_metadata().key_value_metadata().cloned().unwrap_or_default();
    said.retain(|pair| pair.key != "ARROW:schema");
    let properties = WriterProperties::builder().set_key_value_metadata(Some(said)).build();
    let mut writer = ArrowWriter::try_new(File::create(&path).unwrap(), table.schema(), Some(properties)).unwrap();
    writer.write(&table).unwrap();
    writer.close().unwrap();
}

/// The table with a column of another type.
pub fn with_column(table: &RecordBatch, name: &str, edit: impl Fn(&ArrayRef) -> ArrayRef) -> RecordBatch {
    let schema = table.schema();
    let column = |(field, column): (&Arc<Field>, &ArrayRef)| match field.name() == name {
        true => (field.name().clone(), edit(column)),
        false => (field.name().clone(), Arc::clone(column)),
    };
    RecordBatch::try_from_iter(schema.fields().iter().zip(table.columns()).map(column)).unwrap()
}

pub fn edit_column(root: &Path, file: &str, name: &str, edit: impl Fn(&ArrayRef) -> ArrayRef) {
    edit_table(root, file, |table| {
        let at = table.schema().index_of(name).unwrap();
        let mut columns = table.columns().to_vec();
        columns[at] = edit(&columns[at]);
        RecordBatch::try_new(table.schema(), columns).unwrap()
    });
}

/// Edits the whole numbers of a column, by row.
pub fn edit_numbers(root: &Path, file: &str, name: &str, edit: impl Fn(usize, i64) -> i64) {
    edit_column(root, file, name, |column| {
        let numbers = column.as_primitive::<Int64Type>().values();
        Arc::new(Int64Array::from_iter_values(numbers.iter().enumerate().map(|(row, &number)| edit(row, number))))
    });
}

pub fn edit_times(root: &Path, edit: impl Fn(usize, f32) -> f32) {
    edit_column(root, DATA, "timestamp", |column| {
        let times = column.as_primitive::<Float32Type>().values();
        Arc::new(Float32Array::from_iter_values(times.iter().enumerate().map(|(row, &time)| edit(row, time))))
    });
}

/// Edits the numbers that lie in a column of lists, one after the other.
pub fn edit_list(root: &Path, file: &str, name: &str, edit: impl Fn(usize, f64) -> f64) {
    edit_column(root, file, name, |column| {
        let inner = match column.data_type() {
            DataType::FixedSizeList(..) => Arc::clone(column.as_fixed_size_list().values()),
            _ => Arc::clone(column.as_list::<i32>().values()),
        };
        let numbers = cast(&inner, &DataType::Float64).unwrap();
        let numbers = numbers.as_primitive::<Float64Type>().values();
        let edited = Float64Array::from_iter_values(numbers.iter().enumerate().map(|(i, &number)| edit(i, number)));
        let edited = cast(&edited, inner.data_type()).unwrap();
        arrow_array::make_array(column.to_data().into_builder().child_data(vec![edited.to_data()]).build().unwrap())
    });
}

/// The rows of a table in another order, or fewer or more of them.
pub fn edit_rows(root: &Path, file: &str, rows: &[u32]) {
    let rows = arrow_array::UInt32Array::from(rows.to_vec());
    edit_table(root, file, |table| take_record_batch(&table, &rows).unwrap());
}

pub fn set_tasks(root: &Path, episode: usize, texts: &[&str]) {
    edit_column(root, EPISODES, "tasks", |column| {
        let field = match column.data_type() {
            DataType::List(field) => Arc::clone(field),
            other => panic!("{other}"),
        };
        let mut lists = ListBuilder::new(StringBuilder::new()).with_field(field);
        for (row, list) in column.as_list::<i32>().iter().enumerate() {
            match row == episode {
                true => texts.iter().for_each(|text| lists.values().append_value(text)),
                false => list.unwrap().as_string::<i32>().iter().for_each(|text| lists.values().append_option(text)),
            }
            lists.append(true);
        }
        Arc::new(lists.finish())
    });
}

pub fn set_table_of_tasks(root: &Path, numbers: &[i64], texts: &[&str]) {
    edit_table(root, TASKS, |table| {
        let columns: Vec<ArrayRef> =
            vec![Arc::new(Int64Array::from(numbers.to_vec())), Arc::new(StringArray::from(texts.to_vec()))];
        RecordBatch::try_new(table.schema(), columns).unwrap()
    });
}

pub fn problems(checks: &[Check]) -> Vec<String> {
    checks.iter().filter_map(|c| Some(format!("{}: {}", c.name, c.problem.as_ref()?))).collect()
}
