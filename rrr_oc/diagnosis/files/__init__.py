"""What a diagnosis writes: its stages, from which it goes on, and its result, `diagnosis.json`."""
