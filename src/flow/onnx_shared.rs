//! Memory that nodes of graphs share: a decoder that looks several times is several nodes with the same weights.

use std::sync::{Arc, Mutex, PoisonError, Weak};

use crate::flow::winograd;

/// Of all weights that are equal to these the first that are still in use, which may be these.
pub(super) fn first(weights: Arc<[f32]>) -> Arc<[f32]> {
    static KNOWN: Mutex<Vec<Weak<[f32]>>> = Mutex::new(vec![]);
    let mut known = KNOWN.lock().unwrap_or_else(PoisonError::into_inner);
    known.retain(|weights| weights.strong_count() > 0);
    let same = |found: &Arc<[f32]>| winograd::are_equal(found, &weights);
    if let Some(found) = known.iter().filter_map(Weak::upgrade).find(same) {
        return found;
    }
    known.push(Arc::downgrade(&weights));
    weights
}
