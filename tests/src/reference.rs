//! Pages of docs/reference, which are generated.

use std::fs;

use crate::root;

/// Checks that `page` is as it is generated now. With `ACTRM_REFERENCE=write` (`make reference`) it is written.
///
/// # Panics
/// If it is not, or cannot be written.
pub fn assert_current(page: &str, text: &str) {
    let path = root().join(page);
    if std::env::var("ACTRM_REFERENCE").is_ok_and(|what| what == "write") {
        fs::create_dir_all(path.parent().expect("a page lies in a folder")).expect("a folder can be made");
        fs::write(&path, text).expect("a page can be written");
    }
    let found = fs::read_to_string(&path).unwrap_or_default();
    let differs = text.lines().zip(found.lines()).find(|(now, before)| now != before);
    assert!(found == text, "{page} is out of date (run `make reference`): {differs:#?}");
}
