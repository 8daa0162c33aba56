% Reads dappled's slices: octave reader.m ENDPOINT          (Octave: pkg install -forge zeromq)
pkg load zeromq
stream = zmq_socket (ZMQ_SUB);
zmq_setsockopt (stream, ZMQ_RCVHWM, 8);          % the default of 1000 waiting messages would be gigabytes
zmq_setsockopt (stream, ZMQ_SUBSCRIBE, "slices");
zmq_setsockopt (stream, ZMQ_SUBSCRIBE, "end");
zmq_connect (stream, argv (){1});
while true
  topic = char (zmq_recv (stream, 64, 0));
  header = jsondecode (char (zmq_recv (stream, 2^20, 0)));
  if strcmp (topic, "end")
    break
  endif
  array = header.arrays(1);                      % slices: complex64 (K, h, w), little endian, C order
  body = typecast (zmq_recv (stream, 8 * prod (array.shape), 0), "single");
  values = reshape (complex (body(1:2:end), body(2:2:end)), flipud (array.shape(:))');
  slices = permute (values, [3 2 1]);            % slices(k, y, x)
  printf ("frame %d %s %dx%dx%d mean %.6f\n", header.frame, array.name, array.shape, ...
          mean (double (real (slices(1, :)))));
endwhile
