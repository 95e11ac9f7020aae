"""What several tests share: rigs, drawn images, fakes, child programs."""
