//! Puzzles as a Parquet file: one row a puzzle.

use std::fs::File;
use std::os::unix::fs::PermissionsExt;
use std::path::Path;
use std::sync::Arc;

use arrow_array::builder::{ListBuilder, UInt8Builder};
use arrow_array::{ArrayRef, BooleanArray, RecordBatch, StringArray, UInt32Array, UInt64Array};
use parquet::arrow::ArrowWriter;
use parquet::basic::Compression;
use parquet::errors::ParquetError;
use parquet::file::properties::WriterProperties;
use puzzles::{Puzzle, Split, Task};

use crate::error::{DatasetError, Result};

/// Which puzzles to write.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct PuzzleSet {
    /// The family.
    pub task: Task,
    /// The split that all of them belong to.
    pub split: Split,
    /// Cells that a Sudoku keeps at least.
    pub givens: usize,
    /// Seed of the set.
    pub seed: u64,
    /// Number of puzzles.
    pub count: u64,
}

/// Puzzles that are drawn and encoded at a time: what is in memory does not grow with their number.
const PART: u64 = 8192;

/// Draws the puzzles of `set` and writes them to `path`: the same bytes for the same set.
///
/// Columns: `index`, `task`, `split`, `seed`, `height`, `width`, `input` and `target` (lists of u8, row by row), `start`
/// and `goal` (cell numbers), `distance` (steps of the shortest way), `detour` (whether it is longer than without walls)
/// for mazes, `givens` for Sudoku, and `guesses` where a family is told apart by them. `progress` is told how many are drawn.
///
/// # Errors
/// When the file cannot be written.
pub fn write_puzzles(set: &PuzzleSet, path: &Path, progress: &mut dyn FnMut(u64)) -> Result<()> {
    let mut draw = |first: u64| -> Vec<Puzzle> {
        let numbered = |index| set.task.numbered(set.split, (set.givens, set.givens), set.seed, index);
        let part = first..set.count.min(first + PART);
        part.map(|index| (numbered(index), progress(index + 1)).0).collect()
    };
    let mut write = |file: &mut File| -> std::result::Result<(), ParquetError> {
        let properties = WriterProperties::builder().set_compression(Compression::SNAPPY).build();
        let mut writer = ArrowWriter::try_new(file, batch(set, 0, &[])?.schema(), Some(properties))?;
        for first in (0..set.count).step_by(PART as usize) {
            writer.write(&batch(set, first, &draw(first))?)?;
        }
        writer.close()?;
        Ok(())
    };
    let failed = |operation| move |source| DatasetError::Io { path: path.to_owned(), operation, source };
    // the whole file or none: a temporary name beside it, fsync, rename
    let folder = path.parent().filter(|p| !p.as_os_str().is_empty()).unwrap_or_else(|| Path::new("."));
    let mut file = tempfile::Builder::new()
        .prefix(".tmp-")
        .permissions(std::fs::Permissions::from_mode(0o644))
        .tempfile_in(folder)
        .map_err(failed("create a temporary file beside it"))?;
    let operation = "write puzzles to";
    write(file.as_file_mut()).map_err(|source| DatasetError::Parquet { path: path.to_owned(), operation, source })?;
    file.as_file().sync_all().map_err(failed("write"))?;
    file.persist(path).map_err(|e| failed("write")(e.error))?;
    File::open(folder).and_then(|f| f.sync_all()).map_err(failed("sync its folder"))
}

/// The rows of `puzzles`, the first of which is number `first`.
fn batch(
    set: &PuzzleSet,
    first: u64,
    puzzles: &[Puzzle],
) -> std::result::Result<RecordBatch, arrow_schema::ArrowError> {
    let rows = puzzles.len();
    let same = |value: &str| -> ArrayRef { Arc::new(StringArray::from(vec![value; rows])) };
    let side = set.task.side() as u32;
    let sides = || -> ArrayRef { Arc::new(UInt32Array::from(vec![side; rows])) };
    let grids = |cells: fn(&Puzzle) -> Vec<u8>| -> ArrayRef {
        let mut lists = ListBuilder::new(UInt8Builder::new());
        for puzzle in puzzles {
            lists.values().append_slice(&cells(puzzle));
            lists.append(true);
        }
        Arc::new(lists.finish())
    };
    let number = |of: fn(&Puzzle) -> Option<usize>| -> ArrayRef {
        Arc::new(puzzles.iter().map(|puzzle| of(puzzle).map(|n| n as u32)).collect::<UInt32Array>())
    };
    let detours: BooleanArray = puzzles
        .iter()
        .map(|puzzle| match puzzle {
            Puzzle::Maze(maze) => Some(maze.has_detour()),
            Puzzle::Sudoku(..) => None,
        })
        .collect();
    fn start(puzzle: &Puzzle) -> Option<usize> {
        matches!(puzzle, Puzzle::Maze(_)).then(|| position(puzzle, 2))?
    }
    fn goal(puzzle: &Puzzle) -> Option<usize> {
        matches!(puzzle, Puzzle::Maze(_)).then(|| position(puzzle, 3))?
    }
    let mut columns = vec![
        ("index", Arc::new(UInt64Array::from_iter_values(first..first + rows as u64)) as ArrayRef, false),
        ("task", same(set.task.name()), false),
        ("split", same(set.split.name()), false),
        ("seed", Arc::new(UInt64Array::from(vec![set.seed; rows])), false),
        ("height", sides(), false),
        ("width", sides(), false),
        ("input", grids(Puzzle::tokens), false),
        ("target", grids(Puzzle::answer), false),
        ("start", number(start), true),
        ("goal", number(goal), true),
        ("distance", number(Puzzle::distance), true),
        ("detour", Arc::new(detours), true),
        ("givens", number(Puzzle::givens), true),
    ];
    if matches!(set.task, Task::Sudoku(task) if task.is_rated()) {
        let guesses: UInt64Array = puzzles.iter().map(Puzzle::guesses).collect();
        columns.push(("guesses", Arc::new(guesses), true));
    }
    RecordBatch::try_from_iter_with_nullable(columns)
}

fn position(puzzle: &Puzzle, token: u8) -> Option<usize> {
    puzzle.tokens().iter().position(|&t| t == token)
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use super::*;
    use parquet::file::reader::{FileReader, SerializedFileReader};
    use parquet::record::{ListAccessor, RowAccessor};

    #[test]
    fn parts_are_joined_without_a_seam() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("many");
        let task = Task::by_name("maze5-walls").unwrap();
        let set = PuzzleSet { task, split: Split::Train, givens: 0, seed: 1, count: 2 * PART + 5 };
        let mut told = 0;
        write_puzzles(&set, &path, &mut |done| told = done).unwrap();
        assert_eq!(told, set.count);
        let reader = SerializedFileReader::new(std::fs::File::open(&path).unwrap()).unwrap();
        let indices: Vec<u64> =
            reader.get_row_iter(None).unwrap().map(|row| row.unwrap().get_ulong(0).unwrap()).collect();
        assert_eq!(indices, (0..set.count).collect::<Vec<_>>());
    }

    #[test]
    fn what_is_written_reads_back_and_repeats() {
        let folder = tempfile::tempdir().unwrap();
        for name in ["open8", "maze10-original", "sudoku6", "sudoku9-hard"] {
            let task = Task::by_name(name).unwrap();
            let set = PuzzleSet { task, split: Split::Valid, givens: 0, seed: 7, count: 12 };
            let path = folder.path().join(name);
            write_puzzles(&set, &path, &mut |_| {}).unwrap();
            let bytes = std::fs::read(&path).unwrap();
            write_puzzles(&set, &path, &mut |_| {}).unwrap();
            assert_eq!(std::fs::read(&path).unwrap(), bytes);
            let reader = SerializedFileReader::new(std::fs::File::open(&path).unwrap()).unwrap();
            let rows: Vec<_> = reader.get_row_iter(None).unwrap().map(Result::unwrap).collect();
            assert_eq!(rows.len(), 12);
            for (index, row) in rows.iter().enumerate() {
                let puzzle = task.numbered(Split::Valid, (0, 0), 7, index as u64);
                let list = |column: usize| -> Vec<u8> {
                    let list = row.get_list(column).unwrap();
                    (0..list.len()).map(|i| list.get_ubyte(i).unwrap()).collect()
                };
                assert_eq!((list(6), list(7)), (puzzle.tokens(), puzzle.answer()));
                assert_eq!(row.get_uint(10).ok(), puzzle.distance().map(|d| d as u32), "{name}");
                assert_eq!(row.get_uint(12).ok(), puzzle.givens().map(|g| g as u32));
                assert_eq!(row.get_ulong(13).ok(), puzzle.guesses(), "{name}");
                if let Puzzle::Maze(maze) = &puzzle {
                    assert_eq!(row.get_uint(8).unwrap() as usize, maze.start);
                    assert_eq!(row.get_bool(11).unwrap(), maze.has_detour());
                }
            }
        }
    }
}
