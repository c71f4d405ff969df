//! The loop: source, step, sinks; stop, counters, status.
