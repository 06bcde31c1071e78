"""The parts that methods are assembled from: encoders, decoders, pose networks, the vibration branch."""
