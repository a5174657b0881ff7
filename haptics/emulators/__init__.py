"""Programs that answer as a device would, on a real socket or terminal, from what is behind them."""
