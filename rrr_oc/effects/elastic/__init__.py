"""Springs and cables on the links, and deviations of listed springs from what is listed."""
