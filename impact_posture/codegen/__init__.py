"""The C export: emitter, source, manifest, compiler."""
