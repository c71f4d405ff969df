//! Huge pages for weights and feature maps: with small ones a processor spends part of a step looking up where they lie.

use std::{env, fs};

/// Where the kernel says when it gives them.
const ENABLED: &str = "/sys/kernel/mm/transparent_hugepage/enabled";
/// What glibc is set by, which it reads once before a program begins, and what has it ask for huge pages.
pub const SETTING: [&str; 2] = ["GLIBC_TUNABLES", "glibc.malloc.hugetlb=1"];

/// When this process is given huge pages.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Pages {
    /// Where they fit.
    Huge,
    /// If it asked for them, which it does not.
    Unasked,
    /// Never, or nobody knows.
    Small,
}

/// What this process is given.
pub fn found() -> Pages {
    let asks = env::var(SETTING[0]).is_ok_and(|set| set.split(':').any(|one| one == SETTING[1]));
    given(&fs::read_to_string(ENABLED).unwrap_or_default(), asks)
}

/// By what the kernel says, and whether the C library asks.
fn given(enabled: &str, asks: bool) -> Pages {
    match (enabled.contains("[always]"), enabled.contains("[madvise]")) {
        (true, _) => Pages::Huge,
        (_, true) if asks => Pages::Huge,
        (_, true) => Pages::Unasked,
        _ => Pages::Small,
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn who_must_ask_is_told_apart() {
        for (enabled, wanted) in [
            ("[always] madvise never\n", [Pages::Huge; 2]),
            ("always [madvise] never\n", [Pages::Unasked, Pages::Huge]),
            ("always madvise [never]\n", [Pages::Small; 2]),
            ("", [Pages::Small; 2]),
        ] {
            assert_eq!([false, true].map(|asks| given(enabled, asks)), wanted, "{enabled}");
        }
    }
}
