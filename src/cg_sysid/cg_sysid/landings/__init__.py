"""How the feet of a walking robot land: impulses, fits of contact laws, selection."""
