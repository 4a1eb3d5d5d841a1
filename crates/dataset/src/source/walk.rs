//! Walking a file: every group and dataset with type, shape and place, nothing read.

use std::collections::BTreeMap;
use std::fs::File;
use std::io::{Read, Seek, SeekFrom};
use std::path::{Path, PathBuf};

use hdf5::dataset::Layout;
use hdf5::filters::Filter;
use hdf5::plist::file_access::MetadataCacheConfig;
use hdf5::types::TypeDescriptor;
use hdf5::{Dataset, Datatype, Group, IndexType, IterationOrder, LinkType, LocationType};

use super::value::{self, MAX_FIXED, Part, dtype_of, one_line, reason};
use crate::error::InputError;
use crate::sorted_map::SortedMap;
use crate::tree::{Array, Attrs, Dtype};

/// A group as found.
#[derive(Debug, Clone, Default)]
pub(super) struct GroupNode {
    /// How many attributes it has.
    pub attrs: usize,
    /// Whether it has any member.
    pub empty: bool,
}

/// A dataset as found.
#[derive(Debug, Clone)]
pub(super) struct DatasetNode {
    pub dtype: Dtype,
    pub shape: Vec<usize>,
    /// No dataspace (h5py's `Empty`).
    pub null: bool,
    /// Where the elements lie in the file just as in memory.
    pub offset: Option<u64>,
    /// Rows of a stored block; 1 unless chunked.
    pub block_rows: usize,
    pub attrs: usize,
    /// Why it cannot be read, if it cannot.
    pub fault: Option<Box<InputError>>,
}

/// An opened file with everything that it holds, by absolute path without the leading slash; the file's own
/// group has the empty path.
pub(super) struct Walked {
    pub path: PathBuf,
    pub bytes: u64,
    /// Kept open; a folder of many files opens each when it is read.
    file: Option<hdf5::File>,
    pub groups: BTreeMap<String, GroupNode>,
    pub datasets: SortedMap<DatasetNode>,
    /// Those that were found so far, while the file is walked.
    found: BTreeMap<String, DatasetNode>,
    /// Numbers that are converted when read: another byte order, another precision.
    pub foreign: Vec<String>,
    /// Files that links lead to, with their sizes.
    pub linked: Vec<(PathBuf, u64)>,
    /// Links that are not followed: they lead nowhere, in a circle or out of the file's folder.
    pub broken: BTreeMap<String, InputError>,
    /// Objects that are neither group nor dataset.
    pub faults: Vec<InputError>,
    /// Attributes of types that are not carried, by object and name: they are left out.
    pub odd_attrs: BTreeMap<(String, String), String>,
}

/// Groups from the file's own down to the one that is walked: file and place of each.
type Above = Vec<(u64, hdf5::LocationToken)>;

/// Bytes of the library's cache of what is in a file.
const METADATA_CACHE: usize = 2 << 20;
const SIGNATURE: [u8; 8] = [0x89, b'H', b'D', b'F', b'\r', b'\n', 0x1a, b'\n'];
/// Nesting beyond this is a loop or an attack; real files have at most about six levels.
const MAX_DEPTH: usize = 32;
/// No filter packs better than deflate's 1032:1.
const MAX_RATIO: u64 = 1_100;
/// What a dataset without stored elements (all fill value) may claim.
const MAX_UNSTORED: u64 = 16 << 20;

/// Checks that there is a file with an HDF5 signature; gives its size.
pub(super) fn check_signature(path: &Path) -> Result<u64, InputError> {
    let unreadable = |e: std::io::Error| InputError::Unreadable { path: path.to_owned(), reason: e.to_string() };
    // looked at before it is opened: opening a pipe would wait for its writer
    let meta = match std::fs::metadata(path) {
        Ok(meta) => meta,
        Err(e) if e.kind() == std::io::ErrorKind::NotFound => {
            return Err(InputError::NotFound { path: path.to_owned() });
        }
        Err(e) => return Err(unreadable(e)),
    };
    if !meta.is_file() {
        let reason = "not a regular file".to_owned();
        return Err(InputError::Unreadable { path: path.to_owned(), reason });
    }
    let bytes = meta.len();
    let mut file = File::open(path).map_err(unreadable)?;
    // the superblock may follow a user block of 512, 1024, 2048, ... bytes
    let mut at = 0;
    while at + 8 <= bytes {
        let mut found = [0; 8];
        file.seek(SeekFrom::Start(at)).map_err(unreadable)?;
        file.read_exact(&mut found).map_err(unreadable)?;
        if found == SIGNATURE {
            return Ok(bytes);
        }
        at = if at == 0 { 512 } else { at * 2 };
    }
    if is_lfs_pointer(path) {
        return Err(InputError::LfsPointer { path: path.to_owned() });
    }
    let mut first = Vec::new();
    file.seek(SeekFrom::Start(0)).map_err(unreadable)?;
    file.take(8).read_to_end(&mut first).map_err(unreadable)?;
    let found = if first.is_empty() {
        "an empty file".to_owned()
    } else {
        format!("the bytes {}", first.iter().map(|b| format!("{b:02x}")).collect::<Vec<_>>().join(" "))
    };
    Err(InputError::NotHdf5 { path: path.to_owned(), found })
}

/// Whether git-lfs left a pointer where the file belongs.
pub(crate) fn is_lfs_pointer(path: &Path) -> bool {
    const BEGINS: &[u8] = b"version https://git-lfs";
    let mut first = Vec::new();
    let read = File::open(path).and_then(|file| file.take(BEGINS.len() as u64).read_to_end(&mut first));
    read.is_ok() && first == BEGINS
}

/// The two sizes in libhdf5's words about a truncated file.
fn truncated(text: &str) -> Option<(u64, u64)> {
    let number = |key: &str| -> Option<u64> {
        let tail = text.split_once(key)?.1.trim_start_matches([' ', '=']);
        tail.split(|c: char| !c.is_ascii_digit()).next()?.parse().ok()
    };
    text.contains("truncated").then_some(())?;
    Some((number("stored_eof")?, number("eof")?))
}

fn open_file(path: &Path) -> Result<hdf5::File, InputError> {
    // each object is looked at once or twice: a large cache of them would only fill the memory
    let cache = MetadataCacheConfig { max_size: METADATA_CACHE, initial_size: METADATA_CACHE, ..Default::default() };
    hdf5::File::with_options().with_fapl(|p| p.file_locking(false).mdc_config(&cache)).open(path).map_err(|e| {
        let text = reason(&e);
        match truncated(&text) {
            Some((expected, found)) => InputError::Truncated { path: path.to_owned(), expected, found },
            None => damaged(path, "the file", "open", text),
        }
    })
}

impl Walked {
    /// Opens a file and walks it; `keep` holds it open for reading, `beat` is called as the walk goes on.
    pub fn open(path: &Path, keep: bool, beat: &mut dyn FnMut()) -> Result<Self, InputError> {
        let bytes = check_signature(path)?;
        let file = open_file(path)?;
        let mut walked = Self {
            path: path.to_owned(),
            bytes,
            groups: BTreeMap::new(),
            datasets: SortedMap::default(),
            found: BTreeMap::new(),
            foreign: Vec::new(),
            linked: Vec::new(),
            broken: BTreeMap::new(),
            faults: Vec::new(),
            odd_attrs: BTreeMap::new(),
            file: None,
        };
        let types = NativeTypes::new().map_err(|e| damaged(path, "the library", "set up", reason(&e)))?;
        let root: Group = (*file).clone();
        let info = root.loc_info().map_err(|e| damaged(path, "/", "look at", reason(&e)))?;
        let mut above = vec![(info.fileno, info.token)];
        walked.group(&root, "", info.num_attrs, None, &types, &mut above, beat)?;
        walked.datasets = std::mem::take(&mut walked.found).into();
        if keep {
            walked.file = Some(file);
        }
        Ok(walked)
    }

    /// Whether the first element of a dataset begins with these bytes.
    pub fn begins_with(&self, path: &str, node: &DatasetNode, expected: &[u8]) -> bool {
        let Some(offset) = node.offset else {
            return self.read(path, Some((0, 1))).is_ok_and(|first| first.bytes.starts_with(expected));
        };
        let read = File::open(&self.path).and_then(|mut file| {
            let mut found = vec![0; expected.len()];
            file.seek(SeekFrom::Start(offset))?;
            file.read_exact(&mut found).map(|()| found)
        });
        read.is_ok_and(|found| found == expected)
    }

    fn file(&self) -> Result<hdf5::File, InputError> {
        match &self.file {
            Some(file) => Ok(file.clone()),
            None => open_file(&self.path),
        }
    }

    /// Walks a group that lies in this file, or in the linked one of this position.
    #[allow(clippy::too_many_arguments)] // what a recursion hands down
    fn group(
        &mut self,
        group: &Group,
        path: &str,
        attrs: usize,
        from: Option<usize>,
        types: &NativeTypes,
        above: &mut Above,
        beat: &mut dyn FnMut(),
    ) -> Result<(), InputError> {
        let links = group
            .links(IndexType::Name, IterationOrder::Increasing)
            .map_err(|e| damaged(&self.path, path, "list", reason(&e)))?;
        self.groups.insert(path.to_owned(), GroupNode { attrs, empty: links.is_empty() });
        if attrs > 0 {
            self.look_at_attrs(group, path);
        }
        for (name, link) in links {
            let full = if path.is_empty() { name.clone() } else { format!("{path}/{name}") };
            self.check_name(&name, &full)?;
            let is_link = link.link_type != LinkType::Hard;
            let from = match is_link.then(|| self.follow(group, &name, above)).transpose() {
                Ok(followed) => followed.unwrap_or(from),
                Err(reason) => {
                    let error = InputError::Unavailable { path: self.path.clone(), object: full.clone(), reason };
                    self.broken.insert(full, error);
                    continue;
                }
            };
            let info = match group.loc_info_by_name(&name) {
                Ok(info) => info,
                Err(e) => return Err(damaged(&self.path, &full, "follow the link", reason(&e))),
            };
            // each object takes some 100 bytes; more of them than fit are the same ones again and again
            let found = (self.groups.len() + self.found.len()) as u64;
            if found.is_multiple_of(256) {
                beat();
            }
            let limit = 1_000 + (self.bytes + self.linked.iter().map(|(_, bytes)| bytes).sum::<u64>()) / 32;
            if found > limit {
                return Err(InputError::TooLarge {
                    path: self.path.clone(),
                    object: format!("{full} (objects, not bytes)"),
                    bytes: found,
                    limit,
                });
            }
            match info.loc_type {
                LocationType::Group => {
                    if above.contains(&(info.fileno, info.token)) || above.len() > MAX_DEPTH {
                        let reason = "a group that contains itself, or nested too deep".to_owned();
                        return Err(damaged(&self.path, &full, "walk", reason));
                    }
                    let inner = group.group(&name).map_err(|e| damaged(&self.path, &full, "open", reason(&e)))?;
                    above.push((info.fileno, info.token));
                    self.group(&inner, &full, info.num_attrs, from, types, above, beat)?;
                    above.pop();
                }
                LocationType::Dataset => {
                    let dataset = group.dataset(&name).map_err(|e| damaged(&self.path, &full, "open", reason(&e)))?;
                    let (node, native) = self.dataset(&dataset, &full, info.num_attrs, from, types)?;
                    if info.num_attrs > 0 {
                        self.look_at_attrs(&dataset, &full);
                    }
                    if node.dtype.is_numeric() && node.dtype != Dtype::Bool && !native {
                        self.foreign.push(full.clone());
                    }
                    self.found.insert(full, node);
                }
                _ => {
                    let what = "a named type".to_owned();
                    let path = self.path.clone();
                    self.faults.push(InputError::Unsupported { path, object: full, what });
                }
            }
        }
        Ok(())
    }

    /// Follows a soft or external link, which may lead to this file and to files in its folder: gives the position among
    /// the linked ones, or why the link is not followed.
    fn follow(&mut self, group: &Group, name: &str, above: &Above) -> Result<Option<usize>, String> {
        let info = group.loc_info_by_name(name).map_err(|e| {
            // the deepest of the library's words, which its error leaves out
            let stack = e.stack().map(|stack| stack.iter().map(|frame| frame.desc().to_owned()).collect::<Vec<_>>());
            let text = stack.unwrap_or_default().join("; ");
            match text.split_once("external link file name = '").and_then(|(_, tail)| tail.split_once('\'')) {
                Some((file, _)) => format!("a link to the file {file}, which cannot be opened; put it beside this one"),
                None if text.contains("too many") => "a link that leads in a circle".to_owned(),
                None => "a link that leads nowhere".to_owned(),
            }
        })?;
        if info.loc_type == LocationType::Group && above.contains(&(info.fileno, info.token)) {
            return Err("a link to a group that contains it".to_owned());
        }
        let unreadable = |e: hdf5::Error| format!("the target of its link: {}", reason(&e));
        let target = match info.loc_type {
            LocationType::Dataset => group.dataset(name).map_err(unreadable)?.filename(),
            LocationType::Group => group.group(name).map_err(unreadable)?.filename(),
            _ => return Ok(None),
        };
        let target = PathBuf::from(target);
        let resolved = |path: &Path| path.canonicalize().map_err(|e| format!("{}: {e}", path.display()));
        let folder = |path: &Path| match path.parent() {
            Some(folder) if !folder.as_os_str().is_empty() => resolved(folder),
            _ => resolved(Path::new(".")),
        };
        if resolved(&target)? == resolved(&self.path)? {
            return Ok(None);
        }
        if !folder(&target)?.starts_with(folder(&self.path)?) {
            let file = one_line(&target.to_string_lossy());
            return Err(format!("a link to the file {file}, which is outside the folder of this one; put it there"));
        }
        if let Some(known) = self.linked.iter().position(|(path, _)| *path == target) {
            return Ok(Some(known));
        }
        let bytes = std::fs::metadata(&target).map_err(|e| format!("{}: {e}", target.display()))?.len();
        self.linked.push((target, bytes));
        Ok(Some(self.linked.len() - 1))
    }

    /// Takes note of the attributes whose types are not carried.
    fn look_at_attrs(&mut self, location: &hdf5::Location, object: &str) {
        // what cannot be looked at is an error once it is read
        for name in location.attr_names().unwrap_or_default() {
            let dtype = location.attr(&name).and_then(|attr| attr.dtype());
            if let Ok(Dtype::Other(what)) = dtype.map(|dtype| carrier(&dtype)) {
                self.odd_attrs.insert((object.to_owned(), name), what);
            }
        }
    }

    /// Names of the attributes that are carried.
    fn attr_names(&self, location: &hdf5::Location, object: &str) -> Result<Vec<String>, InputError> {
        let names =
            location.attr_names().map_err(|e| damaged(&self.path, object, "list the attributes of", reason(&e)));
        let mut names = names?;
        let path = object.trim_start_matches('/').to_owned();
        names.retain(|name| !self.odd_attrs.contains_key(&(path.clone(), name.clone())));
        names.iter().try_for_each(|name| self.check_name(name, &format!("attribute {name} of {object}")))?;
        Ok(names)
    }

    /// Refuses names that no program writes and that would command the terminal they are shown on.
    fn check_name(&self, name: &str, full: &str) -> Result<(), InputError> {
        if !name.contains(char::is_control) {
            return Ok(());
        }
        let what = "a name with control characters".to_owned();
        Err(InputError::Unsupported { path: self.path.clone(), object: one_line(full), what })
    }

    fn dataset(
        &self,
        dataset: &Dataset,
        full: &str,
        attrs: usize,
        from: Option<usize>,
        types: &NativeTypes,
    ) -> Result<(DatasetNode, bool), InputError> {
        let bad = |operation: &str, e: hdf5::Error| damaged(&self.path, full, operation, reason(&e));
        let unsupported =
            |what: String| Box::new(InputError::Unsupported { path: self.path.clone(), object: full.to_owned(), what });
        let unavailable = |reason: String| {
            Box::new(InputError::Unavailable { path: self.path.clone(), object: full.to_owned(), reason })
        };
        let space = dataset.space().map_err(|e| bad("read the shape of", e))?;
        let null = space.is_null();
        let shape = if null { Vec::new() } else { space.shape() };
        let file_type = dataset.dtype().map_err(|e| bad("read the type of", e))?;
        let (dtype, native) = types.of(&file_type);
        let mut node = DatasetNode { dtype, shape, null, offset: None, block_rows: 1, attrs, fault: None };
        if let Dtype::Other(text) = &node.dtype {
            node.fault = Some(unsupported(format!("the type {text}")));
            return Ok((node, native));
        }
        let bytes = node
            .shape
            .iter()
            .try_fold(node.dtype.size().unwrap_or(16) as u64, |n, &e| n.checked_mul(e as u64))
            .unwrap_or(u64::MAX);
        let too_large =
            |limit| Box::new(InputError::TooLarge { path: self.path.clone(), object: full.to_owned(), bytes, limit });
        if let Some(offset) = dataset.offset() {
            let size = from.map_or(self.bytes, |file| self.linked[file].1);
            // float16 takes more room in memory than in the file
            let stored = node.shape.iter().try_fold(file_type.size() as u64, |n, &e| n.checked_mul(e as u64));
            if stored.and_then(|stored| offset.checked_add(stored)).is_none_or(|end| end > size) {
                node.fault = Some(too_large(size.saturating_sub(offset)));
            } else if native && from.is_none() {
                node.offset = Some(offset);
            }
            return Ok((node, native));
        }
        if matches!(node.dtype, Dtype::FixedStr(width) if width > MAX_FIXED) {
            let what = format!("the type {} in a dataset that is chunked or packed", node.dtype);
            node.fault = Some(unsupported(what));
            return Ok((node, native));
        }
        let plist = dataset.dcpl().map_err(|e| bad("read the layout of", e))?;
        match plist.layout() {
            Layout::Virtual => node.fault = Some(unsupported("a view of other files".to_owned())),
            _ if !plist.external().is_empty() => {
                node.fault = Some(unsupported("storage in another file".to_owned()));
            }
            layout => {
                if let (Layout::Chunked, Some(chunk)) = (layout, plist.chunk()) {
                    node.block_rows = chunk.first().copied().unwrap_or(1).max(1);
                    let block = chunk
                        .iter()
                        .try_fold(node.dtype.size().unwrap_or(16) as u64, |n, &e| n.checked_mul(e as u64))
                        .unwrap_or(u64::MAX);
                    if block > 256 << 20 {
                        node.fault = Some(Box::new(InputError::TooLarge {
                            path: self.path.clone(),
                            object: format!("{full}: one stored block"),
                            bytes: block,
                            limit: 256 << 20,
                        }));
                    }
                }
                let stored = dataset.storage_size();
                let limit = MAX_UNSTORED.max(stored.saturating_mul(MAX_RATIO));
                let unknown: Vec<Filter> = plist.filters().into_iter().filter(|f| !f.is_available()).collect();
                if !unknown.is_empty() {
                    let names: Vec<String> = unknown.iter().map(filter_name).collect();
                    node.fault = Some(unavailable(format!(
                        "it is packed with {}; `h5repack -f NONE`, where that is installed, unpacks the file",
                        names.join(" and ")
                    )));
                } else if stored == 0 && bytes > 0 && !null && node.dtype.size().is_some() {
                    node.fault = Some(unavailable(format!("it was never written: {bytes} bytes stated, none stored")));
                } else if bytes > limit {
                    node.fault = Some(too_large(limit));
                }
            }
        }
        Ok((node, native))
    }

    /// All attributes of a group or dataset.
    pub fn attrs(&self, path: &str) -> Result<Attrs, InputError> {
        let object = if path.is_empty() { "/" } else { path };
        let bad = |e: hdf5::Error| damaged(&self.path, object, "read the attributes of", reason(&e));
        let file = self.file()?;
        if self.datasets.contains_key(path) {
            let dataset = file.dataset(path).map_err(bad)?;
            self.attrs_of(&dataset, object)
        } else {
            let group = if path.is_empty() { (*file).clone() } else { file.group(path).map_err(bad)? };
            self.attrs_of(&group, object)
        }
    }

    /// Names of the attributes of a group, and the values of those among them that are wanted.
    pub fn some_attrs(&self, path: &str, wanted: &[&str]) -> Result<(Vec<String>, Attrs), InputError> {
        let group = self.file()?.group(path).map_err(|e| damaged(&self.path, path, "open", reason(&e)))?;
        let names = self.attr_names(&group, path)?;
        let mut values = Attrs::new();
        for name in names.iter().filter(|n| wanted.contains(&n.as_str())) {
            values.insert(name.clone(), self.one_attr(&group, path, name)?);
        }
        Ok((names, values))
    }

    fn attrs_of(&self, location: &hdf5::Location, object: &str) -> Result<Attrs, InputError> {
        self.attr_names(location, object)?
            .into_iter()
            .map(|name| Ok((name.clone(), self.one_attr(location, object, &name)?)))
            .collect()
    }

    fn one_attr(&self, location: &hdf5::Location, object: &str, name: &str) -> Result<Array, InputError> {
        let full = || format!("attribute {name} of {object}");
        let bad = |e: hdf5::Error| damaged(&self.path, &full(), "read", reason(&e));
        let attr = location.attr(name).map_err(bad)?;
        let space = attr.space().map_err(bad)?;
        let dtype = carrier(&attr.dtype().map_err(bad)?);
        if let Dtype::Other(text) = &dtype {
            return Err(InputError::Unsupported {
                path: self.path.clone(),
                object: full(),
                what: format!("the type {text}"),
            });
        }
        if space.is_null() {
            return Ok(Array { dtype, shape: Vec::new(), bytes: Vec::new() });
        }
        let shape = space.shape();
        let bytes = shape
            .iter()
            .try_fold(dtype.size().unwrap_or(16) as u64, |n, &e| n.checked_mul(e as u64))
            .unwrap_or(u64::MAX);
        if bytes > self.bytes {
            return Err(InputError::TooLarge { path: self.path.clone(), object: full(), bytes, limit: self.bytes });
        }
        let bytes = value::read(&attr, &dtype, Part::All).map_err(|text| damaged(&self.path, &full(), "read", text))?;
        Ok(Array { dtype, shape, bytes })
    }

    /// Reads rows of a dataset, or all of it.
    pub fn read(&self, path: &str, rows: Option<(usize, usize)>) -> Result<Array, InputError> {
        let Some(node) = self.datasets.get(path) else {
            return Err(InputError::NoSuch {
                path: self.path.clone(),
                wanted: format!("dataset {path}"),
                found: format!("{} other datasets", self.datasets.len()),
            });
        };
        if let Some(fault) = &node.fault {
            return Err((**fault).clone());
        }
        let mut shape = node.shape.clone();
        if node.null {
            return Ok(Array { dtype: node.dtype.clone(), shape, bytes: Vec::new() });
        }
        let dataset = self.file()?.dataset(path).map_err(|e| damaged(&self.path, path, "open", reason(&e)))?;
        let part = match rows {
            Some((first, count)) if Some(&count) != shape.first() => {
                let end = first.checked_add(count);
                if end.is_none_or(|end| shape.first().is_none_or(|&rows| end > rows)) {
                    return Err(InputError::NoSuch {
                        path: self.path.clone(),
                        wanted: format!("rows {first} and the {count} after of {path}"),
                        found: format!("shape {shape:?}"),
                    });
                }
                Part::Rows { first, count, shape: &node.shape }
            }
            _ => Part::All,
        };
        let bytes = value::read(&dataset, &node.dtype, part).map_err(|text| damaged(&self.path, path, "read", text))?;
        if let Part::Rows { count, .. } = part {
            shape[0] = count;
        }
        Ok(Array { dtype: node.dtype.clone(), shape, bytes })
    }
}

/// The types whose elements lie in a file as they do in memory.
struct NativeTypes(Vec<(Datatype, Dtype)>);

impl NativeTypes {
    fn new() -> hdf5::Result<Self> {
        let all = [
            Dtype::F64,
            Dtype::F32,
            Dtype::U8,
            Dtype::I64,
            Dtype::I32,
            Dtype::U32,
            Dtype::U64,
            Dtype::I8,
            Dtype::I16,
            Dtype::U16,
        ];
        let mut types = Vec::new();
        for dtype in all {
            if let Ok(descriptor) = value::descriptor_of(&dtype) {
                types.push((Datatype::from_descriptor(&descriptor)?, dtype));
            }
        }
        Ok(Self(types))
    }

    /// The type that carries `file_type`, and whether its elements can be taken from the file as they are.
    fn of(&self, file_type: &Datatype) -> (Dtype, bool) {
        if cfg!(target_endian = "little")
            && let Some((_, dtype)) = self.0.iter().find(|(native, _)| native == file_type)
        {
            return (dtype.clone(), true);
        }
        // byte strings as numpy writes them; libhdf5 would end each at its first zero byte
        let bytes = Datatype::from_descriptor(&TypeDescriptor::FixedAscii(file_type.size()));
        if bytes.is_ok_and(|bytes| bytes == *file_type) {
            return (Dtype::FixedStr(file_type.size()), true);
        }
        (carrier(file_type), false)
    }
}

/// The type that carries a file's type, which libhdf5 converts where they differ.
fn carrier(file_type: &Datatype) -> Dtype {
    match file_type.to_descriptor() {
        Ok(descriptor) => dtype_of(&descriptor),
        // float16 and bfloat16, which float32 holds exactly
        Err(_) if file_type.size() == 2 && file_type.conv_to::<f32>().is_some() => Dtype::F32,
        Err(e) => Dtype::Other(reason(&e)),
    }
}

/// What people call a filter.
fn filter_name(filter: &Filter) -> String {
    let known = match filter.id() {
        4 => "szip",
        307 => "bzip2",
        32001 => "blosc",
        32004 => "lz4",
        32008 => "bitshuffle",
        32013 => "zfp",
        32015 => "zstd",
        32026 => "blosc2",
        id => return format!("a filter that is not known here (HDF5 filter {id})"),
    };
    format!("{known} (HDF5 filter {})", filter.id())
}

fn damaged(path: &Path, object: &str, operation: &str, reason: String) -> InputError {
    let object = if object.is_empty() { "/" } else { object };
    InputError::Damaged { path: path.to_owned(), object: object.to_owned(), operation: operation.to_owned(), reason }
}
