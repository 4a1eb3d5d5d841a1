//! The files of `configs/`, built into the binary so that it works from any folder.

/// Name and text of every file, sorted by name; a test compares the list with the folder.
pub(super) const FILES: &[(&str, &str)] = &[
    ("_act", include_str!("../../../../configs/_act.toml")),
    ("_actrm", include_str!("../../../../configs/_actrm.toml")),
    ("_base", include_str!("../../../../configs/_base.toml")),
    ("act_lift", include_str!("../../../../configs/act_lift.toml")),
    ("actrm_lift", include_str!("../../../../configs/actrm_lift.toml")),
];
