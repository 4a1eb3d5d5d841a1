//! Parquet files that roll over by size, and row groups that are encoded apart from them.
//!
//! [`GroupEncoder`] turns arrays into compressed pages on any thread; [`ShardWriter`] splices the pages into
//! files in order, on one thread. The order of the calls alone decides the bytes.

use super::schema::hex;
use crate::error::{DatasetError, Result};
use arrow_array::ArrayRef;
use arrow_schema::SchemaRef;
use parquet::arrow::ArrowSchemaConverter;
use parquet::arrow::arrow_writer::{ArrowColumnChunk, ArrowRowGroupWriterFactory, compute_leaves};
use parquet::column::writer::ColumnCloseResult;
use parquet::errors::{ParquetError, Result as ParquetResult};
use parquet::file::metadata::{
    ColumnChunkMetaData, PageIndexPolicy, ParquetMetaData, ParquetMetaDataOptions, ParquetMetaDataReader,
};
use parquet::file::properties::WriterProperties;
use parquet::file::statistics::Statistics;
use parquet::file::writer::SerializedFileWriter;
use sha2::{Digest, Sha256};
use std::fs::File;
use std::io::{self, Write};
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::thread::JoinHandle;

/// A file that is hashed while it is written.
pub(crate) struct HashingFile {
    file: File,
    hash: Sha256,
    bytes: u64,
    /// Parquet's writer turns I/O errors into text; the original waits here.
    failure: Option<io::Error>,
    /// Bytes that were on the disk or on their way there when it was last asked for.
    sent: u64,
    sending: Option<JoinHandle<io::Result<()>>>,
}

/// Bytes that are sent to the disk while further ones are made.
const SENT_AT_ONCE: u64 = 16 << 20;

impl HashingFile {
    pub(crate) fn create(path: &Path) -> Result<Self> {
        let file = File::create_new(path).map_err(|source| DatasetError::Io {
            path: path.to_path_buf(),
            operation: "create it",
            source,
        })?;
        Ok(Self { file, hash: Sha256::new(), bytes: 0, failure: None, sent: 0, sending: None })
    }

    /// Writes everything at once and returns what was written.
    pub(crate) fn write_whole(root: &Path, relative: &str, content: &[u8]) -> Result<WrittenFile> {
        let path = root.join(relative);
        create_parent(&path)?;
        let mut file = Self::create(&path)?;
        file.write_all(content).map_err(|source| DatasetError::Io { path, operation: "write it", source })?;
        Ok(file.written(relative))
    }

    /// Begins to send to the disk what has been written, so that less of it is left to do at the end.
    fn send(&mut self) -> io::Result<()> {
        let busy = self.sending.as_ref().is_some_and(|thread| !thread.is_finished());
        if busy || self.bytes - self.sent < SENT_AT_ONCE {
            return Ok(());
        }
        self.arrived()?;
        let file = self.file.try_clone()?;
        self.sent = self.bytes;
        self.sending = Some(std::thread::spawn(move || file.sync_data()));
        Ok(())
    }

    /// Waits for what was sent. A failure is told once: who synchronises the file later does not hear of it.
    fn arrived(&mut self) -> io::Result<()> {
        let sent = self.sending.take().map(JoinHandle::join);
        sent.map_or(Ok(()), |sent| sent.unwrap_or_else(|panic| std::panic::resume_unwind(panic)))
    }

    /// What has been written so far, under the path that it has in the data set.
    pub(crate) fn written(&self, relative: &str) -> WrittenFile {
        let sha256 = hex(self.hash.clone().finalize().as_slice());
        WrittenFile { path: relative.to_owned(), bytes: self.bytes, sha256 }
    }
}

impl Write for HashingFile {
    fn write(&mut self, buffer: &[u8]) -> io::Result<usize> {
        match self.file.write(buffer) {
            Ok(n) => {
                self.hash.update(&buffer[..n]);
                self.bytes += n as u64;
                Ok(n)
            }
            Err(e) => {
                if e.kind() != io::ErrorKind::Interrupted {
                    self.failure = Some(io::Error::new(e.kind(), e.to_string()));
                }
                Err(e)
            }
        }
    }

    fn flush(&mut self) -> io::Result<()> {
        self.file.flush()
    }
}

/// A file of the data set, by its path in it.
#[derive(Debug, Clone, PartialEq, Eq, PartialOrd, Ord)]
pub(crate) struct WrittenFile {
    pub path: String,
    pub bytes: u64,
    pub sha256: String,
}

/// Creates the folder that `path` lies in.
pub(crate) fn create_parent(path: &Path) -> Result<()> {
    let parent = path.parent().expect("a file of a data set lies in a folder");
    std::fs::create_dir_all(parent).map_err(|source| DatasetError::Io {
        path: parent.to_path_buf(),
        operation: "create the folder",
        source,
    })
}

/// Encodes row groups of one schema. Shared between threads.
pub(crate) struct GroupEncoder {
    schema: SchemaRef,
    properties: Arc<WriterProperties>,
    factory: ArrowRowGroupWriterFactory,
}

/// A row group, compressed, not yet in a file.
pub(crate) struct EncodedGroup {
    chunks: Chunks,
    pub rows: usize,
    pub bytes: u64,
}

enum Chunks {
    Encoded(Vec<ArrowColumnChunk>),
    /// In another file, as they are written there.
    Stored(Arc<File>, Vec<ColumnCloseResult>),
}

impl GroupEncoder {
    pub(crate) fn new(schema: SchemaRef, properties: WriterProperties) -> ParquetResult<Self> {
        let properties = Arc::new(properties);
        let nowhere = file_writer(io::sink(), &schema, &properties)?;
        let factory = ArrowRowGroupWriterFactory::new(&nowhere, Arc::clone(&schema));
        Ok(Self { schema, properties, factory })
    }

    pub(crate) fn schema(&self) -> &SchemaRef {
        &self.schema
    }

    /// Encodes one row group; `arrays` follow the schema's fields.
    pub(crate) fn encode(&self, arrays: &[ArrayRef]) -> ParquetResult<EncodedGroup> {
        let mut writers = self.factory.create_column_writers(0)?.into_iter();
        let mut chunks = Vec::new();
        let mut bytes = 0;
        for (field, array) in self.schema.fields().iter().zip(arrays) {
            for leaf in compute_leaves(field, array)? {
                let missing = || ParquetError::General(format!("no writer for {}", field.name()));
                let mut writer = writers.next().ok_or_else(missing)?;
                writer.write(&leaf)?;
                let chunk = writer.close()?;
                bytes += chunk.close().bytes_written;
                chunks.push(chunk);
            }
        }
        Ok(EncodedGroup { chunks: Chunks::Encoded(chunks), rows: arrays.first().map_or(0, |a| a.len()), bytes })
    }
}

fn file_writer<W: Write + Send>(
    to: W,
    schema: &SchemaRef,
    properties: &Arc<WriterProperties>,
) -> ParquetResult<SerializedFileWriter<W>> {
    let descriptor = ArrowSchemaConverter::new().convert(schema)?;
    SerializedFileWriter::new(to, descriptor.root_schema_ptr(), Arc::clone(properties))
}

/// Row groups of a file, to be spliced into others without encoding them again.
pub(crate) struct StoredGroups {
    file: Arc<File>,
    metadata: ParquetMetaData,
    next: usize,
}

impl StoredGroups {
    pub(crate) fn open(path: &Path) -> Result<Self> {
        let file = File::open(path).map_err(|source| DatasetError::Io {
            path: path.to_path_buf(),
            operation: "open it",
            source,
        })?;
        // everything that was written about the pages is written again
        let options = ParquetMetaDataOptions::new().with_encoding_stats_as_mask(false);
        let metadata = ParquetMetaDataReader::new()
            .with_page_index_policy(PageIndexPolicy::Optional)
            .with_metadata_options(Some(options))
            .parse_and_finish(&file)
            .map_err(|source| DatasetError::Parquet { path: path.to_path_buf(), operation: "read it", source })?;
        Ok(Self { file: Arc::new(file), metadata, next: 0 })
    }

    /// The next one, which took so many bytes when it was encoded.
    pub(crate) fn next(&mut self, bytes: u64) -> Option<EncodedGroup> {
        let group = self.metadata.row_groups().get(self.next)?;
        let index = self.metadata.page_index();
        let chunk = |(column, metadata): (usize, &ColumnChunkMetaData)| {
            Ok(ColumnCloseResult {
                bytes_written: metadata.compressed_size() as u64,
                rows_written: group.num_rows() as u64,
                metadata: as_encoded(metadata)?,
                bloom_filter: None,
                column_index: index.and_then(|index| index.column_index(self.next, column)).cloned(),
                offset_index: index.and_then(|index| index.offset_index(self.next, column)).cloned(),
            })
        };
        let chunks = group.columns().iter().enumerate().map(chunk).collect::<ParquetResult<_>>().ok()?;
        let rows = group.num_rows() as usize;
        self.next += 1;
        Some(EncodedGroup { chunks: Chunks::Stored(Arc::clone(&self.file), chunks), rows, bytes })
    }
}

/// What a column chunk says of itself as it does when it was just encoded: whoever reads extremes does not know that they
/// were written in the old place too.
fn as_encoded(metadata: &ColumnChunkMetaData) -> ParquetResult<ColumnChunkMetaData> {
    let both = metadata.column_descr().sort_order().is_signed();
    let statistics = metadata.statistics().cloned().map(|statistics| match statistics {
        Statistics::Boolean(of) => of.with_backwards_compatible_min_max(both).into(),
        Statistics::Int32(of) => of.with_backwards_compatible_min_max(both).into(),
        Statistics::Int64(of) => of.with_backwards_compatible_min_max(both).into(),
        Statistics::Float(of) => of.with_backwards_compatible_min_max(both).into(),
        Statistics::Double(of) => of.with_backwards_compatible_min_max(both).into(),
        other => other,
    });
    match statistics {
        Some(statistics) => metadata.clone().into_builder().set_statistics(statistics).build(),
        None => Ok(metadata.clone()),
    }
}

/// Where a row group went.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) struct Place {
    pub folder: usize,
    pub file: usize,
}

/// Appends encoded row groups to `<root>/<prefix>/chunk-NNN/file-NNN.parquet`.
pub(crate) struct ShardWriter<'a> {
    root: &'a Path,
    prefix: &'static str,
    encoder: &'a GroupEncoder,
    limit: u64,
    files_per_folder: usize,
    number: usize,
    current: Option<(SerializedFileWriter<HashingFile>, u64)>,
    finished: Vec<WrittenFile>,
}

impl<'a> ShardWriter<'a> {
    pub(crate) fn new(
        root: &'a Path,
        prefix: &'static str,
        encoder: &'a GroupEncoder,
        limit: u64,
        files_per_folder: usize,
    ) -> Self {
        Self { root, prefix, encoder, limit, files_per_folder, number: 0, current: None, finished: Vec::new() }
    }

    fn relative(&self) -> String {
        let (folder, file) = (self.number / self.files_per_folder, self.number % self.files_per_folder);
        format!("{}/chunk-{folder:03}/file-{file:03}.parquet", self.prefix)
    }

    fn error(&self, failure: Option<io::Error>, source: ParquetError) -> DatasetError {
        let path = self.root.join(self.relative());
        match failure {
            Some(source) => DatasetError::Io { path, operation: "write it", source },
            None => DatasetError::Parquet { path, operation: "write it", source },
        }
    }

    /// Appends a row group, beginning a new file when the present one would grow beyond the limit and the group
    /// begins an episode: an episode never spans two files.
    pub(crate) fn append(&mut self, group: EncodedGroup, begins_episode: bool) -> Result<Place> {
        if let Some((_, written)) = &self.current
            && begins_episode
            && *written > 0
            && written + group.bytes > self.limit
        {
            self.close_file()?;
            self.number += 1;
        }
        let (mut writer, written) = match self.current.take() {
            Some(current) => current,
            None => {
                let path = self.root.join(self.relative());
                create_parent(&path)?;
                let file = HashingFile::create(&path)?;
                let opened = file_writer(file, self.encoder.schema(), &self.encoder.properties);
                (opened.map_err(|e| self.error(None, e))?, 0)
            }
        };
        let bytes = group.bytes;
        if let Err(e) = splice(&mut writer, group) {
            let failure = writer.inner_mut().failure.take();
            return Err(self.error(failure, e));
        }
        writer.inner_mut().send().map_err(|e| self.lost(e))?;
        self.current = Some((writer, written + bytes));
        Ok(Place { folder: self.number / self.files_per_folder, file: self.number % self.files_per_folder })
    }

    fn close_file(&mut self) -> Result<()> {
        let Some((mut writer, _)) = self.current.take() else { return Ok(()) };
        let closed = writer.finish();
        if let Err(e) = closed {
            let failure = writer.inner_mut().failure.take();
            return Err(self.error(failure, e));
        }
        writer.inner_mut().arrived().map_err(|e| self.lost(e))?;
        self.finished.push(writer.inner().written(&self.relative()));
        Ok(())
    }

    fn lost(&self, source: io::Error) -> DatasetError {
        DatasetError::Io { path: self.root.join(self.relative()), operation: "flush it to disk", source }
    }

    /// Closes the last file; returns all of them in order.
    pub(crate) fn finish(mut self) -> Result<Vec<WrittenFile>> {
        self.close_file()?;
        Ok(self.finished)
    }
}

fn splice(writer: &mut SerializedFileWriter<HashingFile>, group: EncodedGroup) -> ParquetResult<()> {
    let mut row_group = writer.next_row_group()?;
    match group.chunks {
        Chunks::Encoded(chunks) => {
            chunks.into_iter().try_for_each(|chunk| chunk.append_to_row_group(&mut row_group))?;
        }
        Chunks::Stored(file, chunks) => {
            chunks.into_iter().try_for_each(|chunk| row_group.append_column(&*file, chunk))?;
        }
    }
    row_group.close()?;
    writer.flush().map_err(ParquetError::from)
}

/// Writes a Parquet file, a row group at a time.
pub(crate) fn write_parquet(
    root: &Path,
    relative: &str,
    encoder: &GroupEncoder,
    groups: impl IntoIterator<Item = Result<Vec<ArrayRef>>>,
) -> Result<WrittenFile> {
    let path: PathBuf = root.join(relative);
    create_parent(&path)?;
    let failed = |source| DatasetError::Parquet { path: path.clone(), operation: "write it", source };
    let file = HashingFile::create(&path)?;
    let mut writer = file_writer(file, encoder.schema(), &encoder.properties).map_err(failed)?;
    for arrays in groups {
        let written = encoder.encode(&arrays?).and_then(|group| splice(&mut writer, group));
        if let Err(e) = written {
            return Err(match writer.inner_mut().failure.take() {
                Some(source) => DatasetError::Io { path, operation: "write it", source },
                None => failed(e),
            });
        }
    }
    if let Err(e) = writer.finish() {
        return Err(match writer.inner_mut().failure.take() {
            Some(source) => DatasetError::Io { path, operation: "write it", source },
            None => failed(e),
        });
    }
    Ok(writer.inner().written(relative))
}
