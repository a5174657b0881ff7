"""Safety between tissue and hand or motor: virtual coupling, force limits, watchdog, passivity, motion guard."""
