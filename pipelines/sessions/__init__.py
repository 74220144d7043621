"""MCAP recordings and configs, in and out; the only place that knows topics."""
