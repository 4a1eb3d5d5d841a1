//! Files that are either whole or not there.

use std::fs::File;
use std::io::Write;
use std::os::unix::fs::PermissionsExt;
use std::path::Path;

use crate::error::RolloutError;

/// Replaces `path` by `bytes`: a temporary name beside it, fsync, rename, fsync of the folder.
pub(crate) fn write_atomic(path: &Path, bytes: &[u8]) -> Result<(), RolloutError> {
    let folder = path.parent().filter(|p| !p.as_os_str().is_empty()).unwrap_or_else(|| Path::new("."));
    let mut file = tempfile::Builder::new()
        .prefix(".tmp-")
        .permissions(std::fs::Permissions::from_mode(0o644))
        .tempfile_in(folder)
        .map_err(RolloutError::file("creating a temporary file in", folder))?;
    file.write_all(bytes).and_then(|()| file.as_file().sync_all()).map_err(RolloutError::file("writing", path))?;
    file.persist(path).map_err(|e| RolloutError::file("writing", path)(e.error))?;
    File::open(folder).and_then(|f| f.sync_all()).map_err(RolloutError::file("syncing folder", folder))
}
